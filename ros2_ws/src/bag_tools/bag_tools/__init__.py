# SPDX-License-Identifier: Apache-2.0
"""Play, record, run offline, score, report and import rosbags for estimator graphs."""
