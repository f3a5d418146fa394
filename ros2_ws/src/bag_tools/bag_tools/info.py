# SPDX-License-Identifier: Apache-2.0
"""``ros2 run bag_tools info BAG``: what ``ros2 bag info`` says, and rates, gaps and a content hash."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from bag_tools.bag import BagReader
from bag_tools.cli import Progress, guarded
from bag_tools.content import combined, topic_hashes
from bag_tools.series import NANOSECONDS

# A step this many times the median one is called a gap.
GAP_FACTOR = 3.0


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic: `rate` (Hz, from the median step), `gaps` above three median steps, `longest_step` (s)."""

    topic: str
    type: str
    count: int
    rate: float | None
    longest_step: float | None
    gaps: int
    latched: bool
    hash: str | None


@dataclass(frozen=True, slots=True)
class BagInfo:
    """A whole bag: `start` (bag time, ns), `duration` (s), `size` on disk (bytes)."""

    path: str
    size: int
    start: int
    duration: float
    count: int
    hash: str | None
    topics: list[TopicInfo]


def _steps(stamps: list[int]) -> tuple[float | None, float | None, int]:
    if len(stamps) < 2:
        return None, None, 0
    steps = np.diff(np.array(stamps, dtype=np.int64)).astype(np.float64) * 1e-9
    median = float(np.median(steps))
    gaps = int(np.count_nonzero(steps > GAP_FACTOR * median)) if median > 0.0 else 0
    return (1.0 / median if median > 0.0 else None), float(steps.max()), gaps


def size_of(path: Path) -> int:
    """Return the bytes on disk of a bag folder or file."""
    return (
        sum(f.stat().st_size for f in path.rglob('*') if f.is_file())
        if path.is_dir()
        else path.stat().st_size
    )


def describe(path: str | Path, *, hashes: bool = True) -> BagInfo:
    """Read a bag and describe it; `hashes` decodes every message."""
    with BagReader(path) as reader:
        stamps: dict[str, list[int]] = {name: [] for name in reader.topics}
        with Progress('reading', reader.count) as progress:
            for index, (topic, stamp, _) in enumerate(reader.messages()):
                stamps[topic].append(stamp)
                progress.update(index)
        sums = topic_hashes(reader) if hashes else {}
        topics = [
            TopicInfo(t.name, t.type, t.count, *_steps(stamps[t.name]), t.latched, sums.get(t.name))
            for t in sorted(reader.topics.values(), key=lambda t: t.name)
        ]
        return BagInfo(
            path=str(reader.path),
            size=size_of(reader.path),
            start=reader.start,
            duration=max(reader.stop - reader.start - 1, 0) * 1e-9,
            count=reader.count,
            hash=combined(sums) if hashes else None,
            topics=topics,
        )


def to_text(info: BagInfo) -> str:
    """Return the description as aligned text."""
    started = datetime.fromtimestamp(info.start * 1e-9, UTC).strftime('%Y-%m-%d %H:%M:%S UTC')
    head = [
        f'Bag:       {info.path}',
        f'Size:      {info.size / 1024:.1f} KiB',
        f'Start:     {started} ({info.start // NANOSECONDS}.{info.start % NANOSECONDS:09d})',
        f'Duration:  {info.duration:.3f} s',
        f'Messages:  {info.count}',
    ]
    if info.hash:
        head.append(f'Content:   sha256 {info.hash}')
    rows = [('topic', 'type', 'count', 'rate', 'longest step', 'gaps', '')]
    for t in info.topics:
        rate = f'{t.rate:.2f} Hz' if t.rate else '-'
        longest = f'{t.longest_step:.4f} s' if t.longest_step is not None else '-'
        rows.append(
            (t.topic, t.type, str(t.count), rate, longest, str(t.gaps), 'latched' if t.latched else '')
        )
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    right = (2, 3, 4, 5)
    lines = []
    for row in rows:
        cells = (c.rjust(w) if i in right else c.ljust(w) for i, (c, w) in enumerate(zip(row, widths)))
        lines.append('  '.join(cells).rstrip())
    return '\n'.join([*head, '', *lines])


def run(argv: list[str]) -> int:
    """Describe bags on stdout."""
    parser = argparse.ArgumentParser(
        prog='info', description='Describe bags: topics, rates, gaps, content hash.'
    )
    parser.add_argument('bags', nargs='+', help='rosbag2 folders, .mcap or .db3 files')
    parser.add_argument('--json', action='store_true', help='one JSON list instead of text')
    parser.add_argument(
        '--no-hash', action='store_true', help='skip the content hash (it decodes everything)'
    )
    options = parser.parse_args(argv)
    infos = [describe(bag, hashes=not options.no_hash) for bag in options.bags]
    if options.json:
        print(json.dumps([asdict(i) for i in infos], indent=1))
    else:
        print('\n\n'.join(to_text(i) for i in infos))
    return 0


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return guarded('info', run, argv)


if __name__ == '__main__':
    sys.exit(main())
