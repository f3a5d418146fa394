# SPDX-License-Identifier: Apache-2.0
"""Finds what packages offer: ``PKG.codec.ESTIMATORS`` and ``PKG.importers.IMPORTERS``."""

from __future__ import annotations

import importlib
from typing import Any

from bag_tools.bag import BagError
from node_core.ports import Ports


def _table(package: str, module: str, attribute: str) -> dict[str, Any]:
    name = f'{package}.{module}'
    try:
        loaded = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name not in (package, name):  # the module is there but one of its own imports is not
            raise
        raise BagError(f"package '{package}' has no module {name}; expected one with {attribute}") from None
    table = getattr(loaded, attribute, None)
    if not isinstance(table, dict):
        raise BagError(f"package '{package}' declares no {attribute} in {name}")
    return table


def find_ports(package: str, estimator: str) -> Ports:
    """Return the ports of `estimator` in `package`; raise BagError naming what there is instead."""
    table = _table(package, 'codec', 'ESTIMATORS')
    if estimator not in table:
        known = ', '.join(sorted(table)) or 'none'
        raise BagError(f"package '{package}' has no estimator '{estimator}'; it has: {known}")
    return table[estimator]


def find_importer(package: str, name: str) -> Any:
    """Return the importer `name` of `package`: a callable (source path, BagWriter) -> None."""
    table = _table(package, 'importers', 'IMPORTERS')
    if name not in table:
        known = ', '.join(sorted(table)) or 'none'
        raise BagError(f"package '{package}' has no importer '{name}'; it has: {known}")
    return table[name]
