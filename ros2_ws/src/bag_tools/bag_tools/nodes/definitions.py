# SPDX-License-Identifier: Apache-2.0
"""Definitions of message types that rosbags does not know, from the installed packages' .msg files."""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from bag_tools.bag import BagError, jazzy


def installed_store(type_name: str) -> Typestore:
    """Return Jazzy's types and `type_name` with all it contains; raise BagError when a file is missing."""
    known = dict(jazzy().fielddefs)
    todo = [type_name]
    while todo:
        name = todo.pop()
        if name in known:
            continue
        package, _, leaf = name.split('/')
        try:
            path = Path(get_package_share_directory(package)) / 'msg' / f'{leaf}.msg'
            types = get_types_from_msg(path.read_text(), name)
        except (PackageNotFoundError, OSError) as error:
            raise BagError(f"the definition of message type '{name}' is not installed ({error})") from error
        known.update(types)
        todo += [n for _, fields in types.values() for n in _contained(fields)]
    store = get_typestore(Stores.EMPTY)
    store.register(known)
    return store


def _contained(fields: list) -> list[str]:
    names = []
    for _, (_, detail) in fields:
        inner = detail if isinstance(detail, str) else detail[0]
        inner = inner[1] if isinstance(inner, tuple) else inner
        if isinstance(inner, str) and '/' in inner:
            names.append(inner)
    return names
