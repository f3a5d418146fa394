# SPDX-License-Identifier: Apache-2.0
import os

import pytest

from kalman_core import kernel_cache


@pytest.fixture
def source(tmp_path):
    """Packages kalman_core, nav (with tests) and other: modules of time 100, caches of time 200."""
    for package in ('kalman_core', 'nav', 'other'):
        for folder in (package, 'test'):
            cache = tmp_path / package / folder / '__pycache__'
            cache.mkdir(parents=True)
            put(tmp_path / package / folder / 'module.py', 100)
            put(cache / 'module.f-3.py311.nbi', 200)
            put(cache / 'module.f-3.py311.1.nbc', 200)
    (tmp_path / 'stray.txt').touch()
    return tmp_path


def put(path, time):
    path.touch()
    os.utime(path, (time, time))


def left(source):
    return sorted({path.relative_to(source).parts[0] for path in source.rglob('*.nbi')})


def test_caches_newer_than_all_they_may_contain_are_kept(source):
    assert kernel_cache.remove_stale(source) == []
    assert left(source) == ['kalman_core', 'nav', 'other']


def test_a_change_of_a_shared_kernel_makes_all_caches_stale(source):
    put(source / 'kalman_core' / 'kalman_core' / 'module.py', 300)
    assert len(kernel_cache.remove_stale(source)) == 6
    assert left(source) == []
    assert kernel_cache.remove_stale(source) == []


def test_a_change_of_one_package_leaves_the_others_caches_alone(source):
    put(source / 'nav' / 'nav' / 'module.py', 300)
    removed = kernel_cache.remove_stale(source)
    assert {path.relative_to(source).parts[0] for path in removed} == {'nav'}
    assert left(source) == ['kalman_core', 'other']


def test_a_change_of_a_test_makes_no_kernel_stale(source):
    put(source / 'kalman_core' / 'test' / 'module.py', 300)
    assert kernel_cache.remove_stale(source) == []


def test_a_signature_older_than_the_change_makes_its_cache_stale_though_the_index_is_newer(source):
    put(source / 'nav' / 'nav' / 'module.py', 300)
    for folder in ('nav', 'test'):
        put(source / 'nav' / folder / '__pycache__' / 'module.f-3.py311.nbi', 400)
    put(source / 'nav' / 'test' / '__pycache__' / 'module.f-3.py311.1.nbc', 400)
    removed = kernel_cache.remove_stale(source)
    assert removed == [source / 'nav' / 'nav' / '__pycache__' / 'module.f-3.py311.nbi']
    assert not list((source / 'nav' / 'nav').rglob('*.nb?'))
    assert len(list((source / 'nav' / 'test').rglob('*.nb?'))) == 2


def test_the_command_says_how_many_and_refuses_what_is_no_folder(source, capsys):
    assert kernel_cache.main([str(source)]) == 0
    assert capsys.readouterr().out == ''
    put(source / 'kalman_core' / 'kalman_core' / 'module.py', 300)
    assert kernel_cache.main([str(source)]) == 0
    assert capsys.readouterr().out == 'kernel_cache: 6 kernels will be compiled anew\n'
    assert kernel_cache.main([str(source / 'stray.txt')]) == 2
    assert 'is not a folder of packages' in capsys.readouterr().err
