# SPDX-License-Identifier: Apache-2.0
"""A ship's electronic inclinometer: attitude at sea, roll analysis, alarms, NMEA and Modbus."""
