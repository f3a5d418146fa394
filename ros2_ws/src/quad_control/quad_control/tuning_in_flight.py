# SPDX-License-Identifier: Apache-2.0
"""What goes on in flight beside flying: the trial of changed gains, and the relay test of an autotune."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from quad_control.attitude_loop import AXES
from quad_control.params import ControllerParams
from quad_control.trial import Trial
from quad_control.tuning import RelayTest, Ultimate, cascade_for, plant_from_ultimate

# Dead time assumed by the autotune (s); half a sample of hold is added by the plant model.
_ASSUMED_DELAY = 0.005


class TuningInFlight:
    """At most one trial and one relay test; whatever happens is told to `say(kind, text)`."""

    def __init__(self, say: Callable[[str, str], None]) -> None:
        self._say = say
        self.reset()

    def reset(self) -> None:
        """Forget trial, relay test and proposal."""
        self._trial: Trial | None = None
        self.relay: tuple[int, RelayTest] | None = None
        self.proposal: dict[str, float] | None = None

    @property
    def on_trial(self) -> bool:
        """Whether gains are on trial."""
        return self._trial is not None

    def begin_trial(
        self, params: ControllerParams, time: float, before: dict[str, float], changed: list[str]
    ) -> None:
        """Put the `changed` gains on trial at `time` (s); `before` are all gains until now."""
        # A second change during a trial must fall back to the gains that were good before both.
        known = self._trial.before if self._trial else before
        self._trial = Trial(params, time, known)
        self._say('trial', f'{", ".join(changed)} for {params.trial_time:g} s')

    def begin_relay(self, axis: str, params: ControllerParams) -> None:
        """Let a relay drive the rate loop of `axis`."""
        self.relay = (AXES.index(axis), RelayTest(params.relay_amplitude, params.relay_hysteresis))
        self._say('autotune', f'{axis}: relay of {params.relay_amplitude:g} started')

    def stop(self) -> dict[str, float] | None:
        """End both because the motors stop; return the gains to go back to, if any."""
        self.relay = None
        return self._revert('reverted: the motors stopped during the trial') if self._trial else None

    def watch(
        self,
        params: ControllerParams,
        time: float,
        dt: float,
        rate_errors: tuple[float, ...],
        angle_errors: tuple[float, float, float],
        saturated: bool,
    ) -> dict[str, float] | None:
        """Look at one control step (s, s, rad/s, rad); return the gains to go back to, if any."""
        if self.relay:
            self._watch_relay(*self.relay, max(abs(angle_errors[0]), abs(angle_errors[1])), params)
        verdict = self._trial.watch(time, dt, rate_errors, angle_errors, saturated) if self._trial else ''
        if verdict == 'kept':
            self._trial = None
            self._say('trial', verdict)
        elif verdict:
            return self._revert(verdict)
        return None

    def _revert(self, verdict: str) -> dict[str, float]:
        assert self._trial is not None
        before, self._trial = self._trial.before, None
        self._say('trial', verdict)
        return before

    def _watch_relay(self, axis: int, relay: RelayTest, angle_error: float, params: ControllerParams) -> None:
        failed = relay.failed
        if angle_error > params.trial_error:
            failed = f'angle error {angle_error:.2f} rad'
        if failed:
            self.relay = None
            self._say('autotune', f'{AXES[axis]}: stopped, {failed}')
        elif relay.result is not None:
            self.relay = None
            self._propose(AXES[axis], relay.result, relay.period)

    def _propose(self, axis: str, ultimate: Ultimate, period: float) -> None:
        gains = cascade_for(plant_from_ultimate(ultimate, _ASSUMED_DELAY, period))
        self.proposal = {
            f'{axis}_{name}': getattr(gains, name) for name in ('angle_p', 'rate_p', 'rate_i', 'rate_d')
        }
        listed = ', '.join(f'{key} {value:.4g}' for key, value in self.proposal.items())
        self._say(
            'proposal',
            f'{axis}: Ku {ultimate.gain:.3g}, Tu {ultimate.period:.3g} s -> {listed}; {gains.margins}',
        )


def saturates(demand: np.ndarray, achieved: np.ndarray) -> bool:
    """Return whether the mixer could not give a demanded torque (3,) in full."""
    return any(abs(demand[axis] - achieved[axis]) > 1e-9 for axis in range(3))
