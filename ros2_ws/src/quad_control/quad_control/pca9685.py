# SPDX-License-Identifier: Apache-2.0
"""PCA9685 driver without ROS: pulses for speed controllers, and a watchdog that stops the motors.

The chip repeats its last pulses for as long as it has power, whatever happens to the computer; so whoever
owns the driver calls `poll` often, and when commands stay away it goes to idle. When the computer itself dies
the chip goes on: only its OE pin, or controllers that are told otherwise, help against that.

Source: NXP, "PCA9685 16-channel, 12-bit PWM Fm+ I2C-bus LED controller", revision 4 (2015).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from imu_kalman.i2c import I2cBus, I2cDevice, Link, driven, explain

MODE1 = 0x00
MODE2 = 0x01
LED0_ON_L = 0x06
ALL_LED_OFF_H = 0xFD
PRE_SCALE = 0xFE
MODE1_RESTART = 0x80
MODE1_AUTO_INCREMENT = 0x20
MODE1_SLEEP = 0x10
MODE2_TOTEM_POLE = 0x04
FULL_OFF = 0x10
COUNTS = 4096  # per period
OSCILLATOR = 25e6  # Hz, internal
REGISTERS_PER_CHANNEL = 4

_SECOND = 1_000_000_000
_MICROSECOND = 1e-6
# The oscillator needs 0.5 ms after sleep (7.3.1.1).
_START_UP = 1e-3
# A chip that lost power drops all pulses: in the air that has to be seen quickly.
_CHECK_PERIOD = 0.1  # s
# In flight every millisecond without control counts: pauses after a fault are short (s).
_FIRST_DELAY, _LONGEST_DELAY = 0.005, 0.2
# Outside this nothing is a pulse for a speed controller (µs).
_SHORTEST, _LONGEST = 500.0, 2500.0


class PwmParams(Protocol):
    """What the driver needs of params.EscParams; units as there."""

    @property
    def watchdog(self) -> float:
        """Longest time without a command (s)."""

    @property
    def pulse_idle(self) -> float:
        """Pulse of a stopped motor (µs)."""

    @property
    def frequency(self) -> float:
        """PWM frequency (Hz)."""

    @property
    def address(self) -> int:
        """I2C address."""

    @property
    def channels(self) -> tuple:
        """Channel of each motor."""


def prescale_for(frequency: float) -> int:
    """Return PRE_SCALE for the nearest possible frequency (eq. 1 of the datasheet)."""
    return min(max(round(OSCILLATOR / (COUNTS * frequency)) - 1, 3), 255)


class Pca9685Driver:
    """Keeps the pulses of some channels up to date. `steady` measures waiting (ns)."""

    def __init__(self, params: PwmParams, open_bus: Callable[[], I2cBus], steady: Callable[[], int]) -> None:
        self._channels = [int(channel) for channel in params.channels]
        if self._channels != list(params.channels):
            raise ValueError(f'channels {list(params.channels)} are not whole numbers')
        if len(set(self._channels)) != len(self._channels):
            raise ValueError(f'channels {self._channels} are not different from each other')
        self._params = params
        self._steady = steady
        self.link = Link(open_bus, params.address, first_delay=_FIRST_DELAY, longest_delay=_LONGEST_DELAY)
        self._prescale = prescale_for(params.frequency)
        # Width of one count as the chip really makes it (µs).
        self._count = (self._prescale + 1) / OSCILLATOR / _MICROSECOND
        self._idle = (params.pulse_idle,) * len(self._channels)
        self._pulses: tuple[float, ...] = self._idle
        self._running = False
        self._waking_until: int | None = None
        self._commanded_at: int | None = None
        self._next_check = 0
        self._written = False
        self.commands = 0
        self.rejected = 0
        self.timeouts = 0
        self.power_dips = 0

    @property
    def pulses(self) -> tuple[float, ...]:
        """Pulses (µs) that are, or will be on the next contact, given to the motors."""
        return self._pulses

    @property
    def running(self) -> bool:
        """True while the chip follows."""
        return self._running

    def command(self, pulses: Sequence[float]) -> bool:
        """Give each motor its pulse (µs), in the order of `channels`; False when it was not passed on.

        Anything that is not a pulse rejects the whole command and counts as none: the watchdog goes on.
        """
        good = len(pulses) == len(self._channels) and all(
            math.isfinite(pulse) and _SHORTEST <= pulse <= _LONGEST for pulse in pulses
        )
        if not good:
            self.rejected += 1
            return False
        now = self._steady()
        self._commanded_at = now
        self._pulses = tuple(float(pulse) for pulse in pulses)
        self._written = False
        self.commands += 1
        self._serve(now)
        return self._written

    def poll(self) -> None:
        """Do what is due: watchdog, settings, reconnection. To be called at least twice per watchdog time."""
        self._serve(self._steady())

    def close(self) -> None:
        """Stop all pulses and release the bus: a speed controller without pulses stops its motor."""
        try:
            device = self.link.device(self._steady())
            if device is not None:
                device.write(ALL_LED_OFF_H, FULL_OFF)
        except OSError as error:
            self.link.faults[f'closing: {explain(error)}'] += 1
        self._running = False
        self.link.close()

    def diagnostics(self) -> dict[str, Any]:
        """Return what /diagnostics says; 'level' is 0 (ok), 1 (warning) or 2 (error)."""
        link = self.link
        if self._running:
            idle = self._commanded_at is None
            level, message = (1, 'no commands: motors idle') if idle else (0, 'ok')
        elif link.last_fault:
            level, message = 2, f'no contact: {link.last_fault}'
        else:
            level, message = 1, 'starting'
        values: dict[str, Any] = {
            'level': level,
            'message': message,
            'pulses_us': ' '.join(f'{pulse:.1f}' for pulse in self._pulses),
            'frequency_hz': OSCILLATOR / COUNTS / (self._prescale + 1),
            'commands': self.commands,
            'rejected': self.rejected,
            'watchdog_timeouts': self.timeouts,
            'power_dips': self.power_dips,
            'repeated_transfers': link.retried,
            'reconnects': link.reconnects,
        }
        return values | {f'fault: {reason}': count for reason, count in sorted(link.faults.items())}

    def _serve(self, now: int) -> None:
        self._watch(now)
        try:
            device = self.link.device(now)
            if device is not None and self._ready(device, now) and not self._written:
                self._write_pulses(device)
                self.link.works()
                self._written = True
        except OSError as error:
            self._running = False
            self._written = False
            self._waking_until = None
            self.link.failed(self._steady(), explain(error))

    def _watch(self, now: int) -> None:
        if self._commanded_at is None or (now - self._commanded_at) * 1e-9 <= self._params.watchdog:
            return
        self._commanded_at = None
        self._pulses = self._idle
        self._written = False
        self.timeouts += 1

    def _ready(self, device: I2cDevice, now: int) -> bool:
        """Bring the chip up as far as it goes without waiting; True when it takes pulses."""
        if self._waking_until is not None:
            if now < self._waking_until:
                return False
            self._waking_until = None
            if not self._is_set_up(device):
                raise OSError('settings do not hold: is this a PCA9685?')
            self._running = True
        elif not self._running:
            # A chip that still runs as it should keeps its pulses: a disturbed bus must not stop the motors.
            self._running = self._is_set_up(device)
            if not self._running:
                self._set_up(device, now)
                return False
        elif now >= self._next_check and not (self._is_set_up(device) or self._is_set_up(device)):
            # Looked at twice: setting up stops the pulses, one disturbed answer must not.
            self.power_dips += 1
            self._running = False
            self._written = False
            self._set_up(device, now)
            return False
        if now >= self._next_check:
            self._next_check = now + int(_CHECK_PERIOD * _SECOND)
        return True

    def _is_set_up(self, device: I2cDevice) -> bool:
        mode1, mode2 = driven(device.read(MODE1, 2))
        prescale = device.read(PRE_SCALE)[0]
        found = (mode1 & ~MODE1_RESTART, mode2, prescale)
        return found == (MODE1_AUTO_INCREMENT, MODE2_TOTEM_POLE, self._prescale)

    def _set_up(self, device: I2cDevice, now: int) -> None:
        # Asleep no pulse comes out, and only asleep the prescaler can be set.
        device.write(MODE1, MODE1_SLEEP | MODE1_AUTO_INCREMENT)
        device.write(ALL_LED_OFF_H, FULL_OFF)
        device.write(PRE_SCALE, self._prescale)
        device.write(MODE2, MODE2_TOTEM_POLE)
        device.write(MODE1, MODE1_AUTO_INCREMENT)
        self._waking_until = now + int(_START_UP * _SECOND)

    def _write_pulses(self, device: I2cDevice) -> None:
        """Write neighbouring channels in one transfer: they change together, at its end."""
        order = sorted(range(len(self._channels)), key=self._channels.__getitem__)
        run: list[int] = []
        start = 0
        for position in order:
            channel = self._channels[position]
            if run and channel != start + len(run) // REGISTERS_PER_CHANNEL:
                device.write(LED0_ON_L + REGISTERS_PER_CHANNEL * start, *run)
                run = []
            if not run:
                start = channel
            counts = min(round(self._pulses[position] / self._count), COUNTS - 1)
            run += [0, 0, counts & 0xFF, counts >> 8]
        device.write(LED0_ON_L + REGISTERS_PER_CHANNEL * start, *run)
