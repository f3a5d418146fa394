# SPDX-License-Identifier: Apache-2.0
"""Constants of the GPS and Galileo signal interface documents (IS-GPS-200, Galileo OS SIS ICD)."""

SPEED_OF_LIGHT = 299_792_458.0  # m/s
EARTH_RATE = 7.2921151467e-5  # rad/s, value both interface documents prescribe for orbits
GPS_MU = 3.986005e14  # m^3/s^2, IS-GPS-200 table 20-IV
GALILEO_MU = 3.986004418e14  # m^3/s^2, OS SIS ICD table 67
GPS_EPOCH_UNIX = 315_964_800  # s, 1980-01-06T00:00:00 as Unix time
WEEK = 604_800  # s

GPS = 0
GALILEO = 1
SYSTEM_LETTERS = 'GE'

FREQUENCY_L1 = 1_575.42e6  # Hz, GPS L1 and Galileo E1
FREQUENCY_L2 = 1_227.60e6  # Hz
FREQUENCY_L5 = 1_176.45e6  # Hz, GPS L5 and Galileo E5a
FREQUENCY_E5B = 1_207.14e6  # Hz
WAVELENGTH_L1 = SPEED_OF_LIGHT / FREQUENCY_L1  # m
