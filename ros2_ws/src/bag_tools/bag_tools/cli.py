# SPDX-License-Identifier: Apache-2.0
"""What every command line here shares: one clear line on errors, exit codes, a progress bar."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from types import TracebackType

from bag_tools.bag import BagError
from kalman_core.parameters import ParameterError

EXIT_USAGE = 2
EXIT_INTERRUPTED = 130
# A bar for shorter work would only flicker.
_QUIET = 2.0  # s
_REDRAW = 0.2  # s
_WIDTH = 30  # characters


def guarded(
    name: str,
    main: Callable[[list[str]], int],
    argv: list[str] | None,
    interrupted: int = EXIT_INTERRUPTED,
) -> int:
    """Run ``main(arguments)``; turn what the user can mend into one line on stderr and exit code 2.

    `interrupted` is the exit code after Ctrl-C: nodes end with 0, work that is left undone does not.
    """
    try:
        return main(sys.argv[1:] if argv is None else argv)
    except (BagError, ParameterError) as error:
        print(f'{name}: {" ".join(str(error).split())}', file=sys.stderr)
        return EXIT_USAGE
    except OSError as error:
        where = f'{error.filename}: ' if error.filename else ''
        print(f'{name}: {where}{error.strerror or error}', file=sys.stderr)
        return EXIT_USAGE
    except KeyboardInterrupt:
        return interrupted


class Progress:
    """A bar on stderr for work that lasts longer than two seconds; on a terminal only, unless `force`."""

    def __init__(self, label: str, total: float, *, force: bool = False) -> None:
        self._label = label
        self._total = max(total, 1e-9)
        self._start = self._drawn = time.monotonic()
        self._shown = False
        self._enabled = force or sys.stderr.isatty()

    def update(self, done: float) -> None:
        """Say how much of the total is done; draws at most five times a second."""
        now = time.monotonic()
        if not self._enabled or now - self._drawn < _REDRAW or now - self._start < _QUIET:
            return
        self._drawn = now
        self._shown = True
        share = min(max(done / self._total, 0.0), 1.0)
        filled = round(share * _WIDTH)
        left = (now - self._start) * (1.0 - share) / share if share > 0.0 else float('inf')
        rest = f'{left:4.0f} s left' if left < 1e5 else ''
        bar = '█' * filled + '·' * (_WIDTH - filled)
        print(f'\r{self._label} {bar} {100 * share:3.0f} % {rest:12}', end='', file=sys.stderr, flush=True)

    def close(self) -> None:
        """Wipe the bar."""
        if self._shown:
            print('\r\x1b[K', end='', file=sys.stderr, flush=True)
            self._shown = False

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _tb: TracebackType | None
    ) -> None:
        self.close()
