# SPDX-License-Identifier: Apache-2.0
"""Topics of this package, relative to the node's namespace."""

IMU = 'imu/data_raw'
MAG = 'imu/mag'
GNSS = 'gnss/velocity'
LOG = 'log/speed'
ATTITUDE = 'imu/data'
SETTLED = 'imu/data_settled'
ANGLES = 'ship/attitude'
VALIDITY = 'ship/validity'
ROLL = 'ship/roll'
MAXIMA = 'ship/roll_maxima'
ALARMS = 'ship/alarms'
COMMAND = 'ship/command'
SETTINGS = 'ship/settings'
