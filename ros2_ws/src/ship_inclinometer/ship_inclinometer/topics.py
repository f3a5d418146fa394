# SPDX-License-Identifier: Apache-2.0
"""Topics of this package, relative to the node's namespace."""

IMU = 'imu/data_raw'
MAG = 'imu/mag'
GNSS = 'gnss/velocity'
LOG = 'log/speed'
ATTITUDE = 'imu/data'
SETTLED = 'imu/data_settled'
ANGLES = 'ship/attitude'
RATES = 'ship/rates'
VALIDITY = 'ship/validity'
ROLL = 'ship/roll'
SPECTRUM = 'ship/roll_spectrum'
ALARMS = 'ship/alarms'
