# SPDX-License-Identifier: Apache-2.0
"""Every command in every document runs, and prints what the document shows."""

import ast
import builtins
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from workspace_harness.documents import EXEMPT, blocks, documents, exemption, same_text, stays
from workspace_harness.make_bags import root

NAMES = [str(path.relative_to(root())) for path in documents()]
COMMANDS = {
    name: [c for block in blocks((root() / name).read_text(encoding='utf-8')) for c in block.commands]
    for name in NAMES
}


# Commands mostly wait, for discovery and for each other: two documents at a time keep two cores busy.
AT_A_TIME = 2


def run(name):
    argv = [sys.executable, '-m', 'workspace_harness.documents', name]
    return subprocess.run(argv, capture_output=True, text=True, cwd=root(), check=False)


@pytest.fixture(scope='module')
def results():
    """What running each document says, begun with the longest."""
    with ThreadPoolExecutor(AT_A_TIME) as pool:
        yield {name: pool.submit(run, name) for name in sorted(NAMES, key=lambda name: -len(COMMANDS[name]))}
        pool.shutdown(cancel_futures=True)


@pytest.mark.parametrize('name', [name for name in NAMES if COMMANDS[name]])
def test_every_command_of_a_document_runs(results, name):
    done = results[name].result()
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_link_between_documents_leads_somewhere():
    broken = []
    for name in NAMES:
        path = root() / name
        text = re.sub(r'^```.*?^```$', '', path.read_text(encoding='utf-8'), flags=re.DOTALL | re.MULTILINE)
        for target in re.findall(r'\]\(([^)\s]+)\)', text):
            file, _, anchor = target.partition('#')
            if '://' in target:
                continue
            there = (path.parent / file) if file else path
            if not there.exists() or (anchor and anchor not in anchors(there)):
                broken.append(f'{name}: {target}')
    assert not broken


def anchors(path):
    """Return the anchors that headings get."""
    headings = re.findall(r'^#+ (.*)$', path.read_text(encoding='utf-8'), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', heading.lower()).replace(' ', '-') for heading in headings}


def test_blocks_are_found_and_taken_apart():
    text = (
        'Words.\n\n    ros2 run a b &\n    ros2 topic list   # what is there\n\n'
        '```sh\nros2 run c d & ros2 run e f &\npython x.py \\\n  --long\n```\n\n```text\nout 1\n```\n\n'
        '```python\nros2 = 1\n```\n\n    not a command\n'
    )
    first, second = blocks(text)
    assert first.commands == ('ros2 run a b', 'ros2 topic list')
    assert first.output is None
    assert second.commands == ('ros2 run c d', 'ros2 run e f', 'python x.py --long')
    assert text[slice(*second.output)] == 'out 1\n'


def test_outputs_agree_when_words_do_and_numbers_nearly_do():
    assert same_text('error 1.00 m\n', 'error  1.001 m\n')
    assert not same_text('error 1.0 m\n', 'error 1.1 m\n')
    assert not same_text('error 1.0 m\n', 'errors 1.0 m\n')
    assert not same_text('1 2\n', '1\n')


def test_every_exemption_is_used_and_has_a_reason():
    commands = [command for name in NAMES for command in COMMANDS[name]]
    assert len(commands) > 60
    for pattern, reason in EXEMPT.items():
        assert reason
        assert any(re.search(pattern, command) for command in commands), f'{pattern} is not needed'
    # Most of them do run: the list may not become the way out.
    assert sum(exemption(command) is None for command in commands) > 0.6 * len(commands)


def test_nodes_are_told_from_tools():
    assert stays('ros2 run imu_kalman attitude_estimator')
    assert stays('ros2 run bag_tools record out imu/data')
    assert not stays('ros2 run bag_tools record out imu/data --count 3')
    assert not stays('ros2 run bag_tools score a b c')
    assert not stays('ros2 run bag_tools play x.mcap')


PYTHON = re.compile(r'^```python\n(.*?)^```$', re.DOTALL | re.MULTILINE)
CODE = [
    (name, code) for name in NAMES for code in PYTHON.findall((root() / name).read_text(encoding='utf-8'))
]


def readers_own(tree):
    """Return the names that a block uses and does not make: they stand for the reader's data."""
    names = [node for node in ast.walk(tree) if isinstance(node, ast.Name)]
    made = {node.id for node in names if isinstance(node.ctx, ast.Store)} | set(dir(builtins))
    made |= {node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef | ast.FunctionDef)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            made |= {alias.asname or alias.name.split('.')[0] for alias in node.names}
    return {node.id for node in names} - made


@pytest.mark.parametrize(('name', 'code'), CODE, ids=[f'{name}-{i}' for i, (name, _) in enumerate(CODE)])
def test_code_of_a_document_imports_what_is_there_and_runs_where_it_is_whole(
    tmp_path, monkeypatch, name, code
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'bags').symlink_to(root() / 'bags')
    (tmp_path / 'out').mkdir()
    tree = ast.parse(code)
    if readers_own(tree):
        tree.body = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    exec(compile(tree, name, 'exec'), {})


def test_some_code_of_documents_is_whole():
    whole = [name for name, code in CODE if not readers_own(ast.parse(code))]
    assert len(whole) >= 4, whole
