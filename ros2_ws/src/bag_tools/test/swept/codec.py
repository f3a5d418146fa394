# SPDX-License-Identifier: Apache-2.0
"""A package for sweeps whose workers are processes of their own: the estimators of bag_samples."""

from bag_samples import ESTIMATORS

__all__ = ['ESTIMATORS']
