# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import pytest

from ev_velocity import calibration
from ev_velocity import velocity_memory as mem
from ev_velocity.params import VelocityParams
from ev_velocity.velocity import VelocityEstimator
from kalman_core.parameters import ParameterError


@pytest.fixture
def params(tmp_path):
    return replace(VelocityParams(), calibration_file=str(tmp_path / 'car' / 'wheels.json'))


def learned_estimator(params):
    estimator = VelocityEstimator(params)
    estimator.state[mem.X + mem.S] = -0.0123
    estimator.state[mem.P + mem.S * (mem.N + 1)] = 0.002**2
    return estimator


def test_what_is_saved_starts_the_next_drive(params):
    assert calibration.load(params) == params
    assert calibration.save(learned_estimator(params))
    again = calibration.calibrated(params)
    assert again.params.scale == -0.0123
    assert again.params.scale_sigma == pytest.approx((0.002**2 + calibration.AGEING_SIGMA**2) ** 0.5)
    assert again.state[mem.X + mem.S] == -0.0123


def test_a_drive_that_learned_nothing_spoils_no_file(params):
    calibration.save(learned_estimator(params))
    assert not calibration.save(calibration.calibrated(params))
    assert calibration.load(params).scale == -0.0123
    assert not calibration.save(VelocityEstimator())


def test_what_could_not_be_loaded_again_is_not_saved(params):
    calibration.save(learned_estimator(params))
    far = learned_estimator(params)
    far.state[mem.X + mem.S] = 0.25
    with pytest.raises(ParameterError, match=r"wheels\.json.*'scale'"):
        calibration.save(far)
    assert calibration.load(params).scale == -0.0123


def test_a_live_change_leaves_what_the_file_said(params):
    calibration.save(learned_estimator(params))
    estimator = calibration.calibrated(params)
    sigma = estimator.params.scale_sigma
    # The node hands over its own parameters, which know nothing of the file.
    estimator.set_params(replace(params, gate=12.0))
    estimator.reset()
    assert estimator.params.gate == 12.0
    assert estimator.learned()['scale'] == -0.0123
    assert estimator.params.scale_sigma == sigma
    assert not calibration.save(estimator)


@pytest.mark.parametrize(
    'text', ['{', '{}', '[]', '{"scale": 5.0, "scale_sigma": 1e-3, "slip": 0, "slip_sigma": 0}']
)
def test_a_bad_file_is_named(params, text, tmp_path):
    path = tmp_path / 'car' / 'wheels.json'
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(ParameterError, match=r'wheels\.json'):
        calibration.load(params)


def test_a_full_disk_leaves_the_old_file_and_no_other(params, monkeypatch):
    calibration.save(learned_estimator(params))

    def full(*_):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(calibration.os, 'replace', full)
    better = learned_estimator(params)
    better.state[mem.X + mem.S] = 0.05
    with pytest.raises(OSError, match='No space left'):
        calibration.save(better)
    assert calibration.load(params).scale == -0.0123
    assert [path.name for path in Path(params.calibration_file).parent.iterdir()] == ['wheels.json']
