# SPDX-License-Identifier: Apache-2.0
"""`./ws audit` names what is known, and never calls what was not looked up safe."""

import importlib.util

import pytest
from workspace_harness.make_bags import root

KNOWN = {
    'name': 'sieve',
    'version': '1.0',
    'vulns': [
        {'id': 'PYSEC-1', 'fix_versions': ['1.1', '2.0']},
        {'id': 'PYSEC-2', 'fix_versions': []},
    ],
}


@pytest.fixture(scope='module')
def audit():
    spec = importlib.util.spec_from_file_location('audit', root() / 'tools' / 'audit.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_known_weakness_is_named_with_what_mends_it(audit):
    lines, known = audit.report(
        [KNOWN, {'name': 'safe', 'version': '2', 'vulns': []}, {'name': 'own', 'skip_reason': 'not there'}]
    )
    assert lines == [
        'sieve 1.0: PYSEC-1, mended in 1.1, 2.0',
        'sieve 1.0: PYSEC-2, mended in no version yet',
    ]
    assert known == 2


@pytest.mark.parametrize(
    ('answer', 'code', 'said'),
    [
        ('{"dependencies": [{"name": "own", "skip_reason": "x"}]}', 0, '0 of 1 packages looked up'),
        ('', 0, 'no answer from the package index'),
        (None, 1, 'PYSEC-2'),
    ],
)
def test_only_a_known_weakness_fails(audit, monkeypatch, capsys, answer, code, said):
    import json

    text = json.dumps({'dependencies': [KNOWN]}) if answer is None else answer
    monkeypatch.setattr(
        audit.subprocess, 'run', lambda *_a, **_k: audit.subprocess.CompletedProcess([], 0, text, 'no route')
    )
    assert audit.main() == code
    assert said in capsys.readouterr().out
