# SPDX-License-Identifier: Apache-2.0
"""Makes docs/report.png, the picture in the README, from the report of the last `./ws run`, by chromium."""

import argparse
import io
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
NAMES = ('chromium', 'chromium-browser', 'google-chrome')
# Wide enough for two figures side by side, high enough for table, graph and the first paper's figures.
WIDTH, HEIGHT = 1240, 1700
LARGEST = 300_000  # bytes


def screenshot(browser: str, page: Path, target: Path) -> None:
    """Write the top of `page` to `target`."""
    with tempfile.TemporaryDirectory() as profile:
        subprocess.run(
            [
                browser, '--headless=new', '--no-sandbox', '--disable-gpu', '--hide-scrollbars',
                f'--user-data-dir={profile}', f'--window-size={WIDTH},{HEIGHT}',
                '--blink-settings=preferredColorScheme=1', f'--screenshot={target}', page.as_uri(),
            ],
            check=True,
            capture_output=True,
            timeout=120,
        )  # fmt: skip


def main() -> int:
    """Write the picture; 2 when there is no report or no browser."""
    parser = argparse.ArgumentParser(prog='./ws docs --picture', description=__doc__)
    parser.add_argument('page', nargs='?', type=Path, default=ROOT / 'out' / 'report.html')
    parser.add_argument('--out', type=Path, default=ROOT / 'docs' / 'report.png')
    o = parser.parse_args()
    browser = next((path for path in map(shutil.which, NAMES) if path), None)
    if browser is None or not o.page.is_file():
        missing = 'a chromium' if browser is None else f'{o.page}; run ./ws run first'
        print(f'picture: there is no {missing}', file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        screenshot(browser, o.page.resolve(), Path(folder) / 'page.png')
        picture = Image.open(Path(folder) / 'page.png').convert('RGB')
    # A drawing has few colours: a palette of its own makes it a third of the size.
    data = io.BytesIO()
    picture.quantize(96, dither=Image.Dither.NONE).save(data, 'png', optimize=True)
    if len(data.getvalue()) > LARGEST:
        print(f'picture: {len(data.getvalue())} bytes, expected at most {LARGEST}', file=sys.stderr)
        return 1
    o.out.write_bytes(data.getvalue())
    print(f'{o.out}: {len(data.getvalue()) // 1000} kB')
    return 0


if __name__ == '__main__':
    sys.exit(main())
