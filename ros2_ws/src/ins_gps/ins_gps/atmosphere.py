# SPDX-License-Identifier: Apache-2.0
"""Delay of a code signal in ionosphere and troposphere.

Sources: Klobuchar, IEEE Trans. AES 23(3), 1987, as in IS-GPS-200N figure 20-4; Saastamoinen 1972 with the
standard atmosphere (ICAO), with the curvature term B(h) tan^2 z (table in Saastamoinen, fitted to 1 %).
"""

import math

from numba import njit

from ins_gps.constants import SPEED_OF_LIGHT

# Night-time vertical delay (s) of the Klobuchar model, used where a file brings no coefficients.
NIGHT_DELAY = 5e-9
# Below 3 degrees the expansion in tan z diverges; the delay is held at its value there.
_LOWEST_SINE = 0.05233595624294383


@njit(cache=True, nogil=True)
def klobuchar(coefficients, latitude, longitude, azimuth, elevation, time):
    """Return the L1 code delay (m).

    coefficients: (8,) alpha then beta as broadcast; position and direction in rad; time: GPS seconds.
    """
    el = elevation / math.pi
    psi = 0.0137 / (el + 0.11) - 0.022
    phi = latitude / math.pi + psi * math.cos(azimuth)
    phi = min(0.416, max(-0.416, phi))
    lam = longitude / math.pi + psi * math.sin(azimuth) / math.cos(phi * math.pi)
    phi_m = phi + 0.064 * math.cos((lam - 1.617) * math.pi)
    local = (43_200.0 * lam + time) % 86_400.0
    slant = 1.0 + 16.0 * (0.53 - el) ** 3
    amplitude, period = 0.0, 0.0
    power = 1.0
    for i in range(4):
        amplitude += coefficients[i] * power
        period += coefficients[4 + i] * power
        power *= phi_m
    amplitude = max(0.0, amplitude)
    period = max(72_000.0, period)
    x = 2.0 * math.pi * (local - 50_400.0) / period
    delay = NIGHT_DELAY
    if abs(x) < 1.57:
        delay += amplitude * (1.0 - x * x / 2.0 + x * x * x * x / 24.0)
    return SPEED_OF_LIGHT * slant * delay


@njit(cache=True, nogil=True)
def saastamoinen(latitude, height, elevation, humidity=0.5):
    """Return the tropospheric delay (m) at an ellipsoidal height (m) and elevation (rad).

    Zero below the horizon; heights are limited to the model's -100 m ... 10 km.
    """
    if elevation <= 0.0:
        return 0.0
    h = min(10_000.0, max(0.0, height))
    pressure = 1_013.25 * (1.0 - 2.2557e-5 * h) ** 5.2568
    temperature = 15.0 - 6.5e-3 * h + 273.16
    vapour = 6.108 * humidity * math.exp((17.15 * temperature - 4_684.0) / (temperature - 38.45))
    sine = max(math.sin(elevation), _LOWEST_SINE)
    dry = 0.0022768 * pressure / (1.0 - 0.00266 * math.cos(2.0 * latitude) - 0.00028 * h / 1e3)
    wet = 0.002277 * (1_255.0 / temperature + 0.05) * vapour
    curvature = 0.002277 * 1.156 * math.exp(-h / 7_000.0) * (1.0 / (sine * sine) - 1.0)
    return (dry + wet - curvature) / sine
