"""Bags of all writers, undamaged and damaged."""

import argparse
import io
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, Writer

from thinmap_ros.core.errors import counted
from thinmap_ros.logs.bag_writer import BagWriter
from thinmap_ros.logs.log import LaserOptions
from thinmap_ros.logs.readers.bag import Bag
from thinmap_ros.logs.readers.carmen import CarmenLog
from thinmap_ros.tools import bag_repair, cli
from thinmap_ros.tools.carmen_to_bag import convert

SCANS = 60
CASES = 60
QOS = (
    '- {history: 1, depth: 5, reliability: 1, durability: 2, liveliness: 1, '
    'deadline: {sec: 1, nsec: 0}, lifespan: {sec: 1, nsec: 0}, '
    'liveliness_lease_duration: {sec: 1, nsec: 0}, avoid_ros_namespace_conventions: false}'
)


def drive(path: Path, scans: int = SCANS) -> Path:
    """A bag as carmen_to_bag writes it."""
    log = path.with_suffix('.clf')
    rng = np.random.default_rng(1)
    with log.open('w') as out:
        for k in range(scans):
            ranges = ' '.join(f'{r:.2f}' for r in rng.uniform(1.0, 9.0, 90))
            stamp = f'{100.0 + 0.2 * k:.3f}'
            out.write(f'FLASER 90 {ranges} 0 0 0 {0.01 * k:.3f} 0 0 {stamp} host {stamp}\n')
    convert(CarmenLog(log, LaserOptions()), path)
    return path


def rewritten(source: Path, target: Path, **options: Any) -> Path:
    """The same messages by another writer, with the QoS of each topic."""
    with source.open('rb') as stream, target.open('wb') as out:
        writer = Writer(out, chunk_size=20_000, **options)
        writer.start(profile='ros2')
        channels: dict[str, int] = {}
        messages = NonSeekingReader(stream).iter_messages(log_time_order=False)
        for schema, channel, message in messages:
            assert schema is not None
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, 'cdr', number, {'offered_qos_profiles': QOS}
                )
            writer.add_message(
                channels[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return target


def compressed(source: Path, target: Path) -> Path:
    """The same messages by the project's own writer, with zstd."""
    bag = Bag(source)
    with BagWriter(target, compressed=True) as writer:
        for message in bag.messages():
            writer.write(message.topic, message.type_name, message.log_ns, message.data)
    return target


MAKERS: dict[str, Callable[[Path, Path], Path]] = {
    'none': lambda source, target: source,
    'zstd': compressed,
    'zstd with checksums': lambda s, t: rewritten(s, t, compression=CompressionType.ZSTD),
    'lz4': lambda s, t: rewritten(s, t, compression=CompressionType.LZ4),
    'lz4 without checksums': lambda s, t: rewritten(
        s, t, compression=CompressionType.LZ4, enable_crcs=False
    ),
    'without chunks': lambda s, t: rewritten(s, t, use_chunking=False, enable_crcs=False),
}


def whole_bags(folder: Path) -> dict[str, bytes]:
    """One drive in the format of each writer."""
    source = drive(folder / 'drive.mcap')
    files = {name: make(source, folder / f'{name}.mcap') for name, make in MAKERS.items()}
    return {name: file.read_bytes() for name, file in files.items()}


def damaged(whole: bytes, rng: np.random.Generator) -> bytes:
    """A copy with flipped bits, truncated, with a zeroed range, or with a repeated block."""
    content = bytearray(whole)
    kind = rng.choice(['flip', 'flip', 'flip', 'cut', 'zero', 'repeat'])
    at = int(rng.integers(8, len(content)))
    length = int(rng.integers(1, max(2, len(content) // int(rng.choice([2, 20, 500])))))
    if kind == 'flip':
        # Many of the flipped bits are in the headers and indices at both ends.
        near = rng.choice([len(content), 3000])
        for _ in range(int(rng.integers(1, 9))):
            place = int(rng.integers(8, min(near, len(content))))
            place = place if rng.random() < 0.7 else len(content) - place
            content[place] ^= 1 << int(rng.integers(8))
    elif kind == 'cut':
        del content[at:]
    elif kind == 'zero':
        content[at : at + length] = bytes(len(content[at : at + length]))
    else:
        content[at:at] = content[at : at + length]
    return bytes(content)


def ended(main: Callable[[], None], *arguments: str) -> tuple[int, str, str]:
    """Exit code and output of a program; raises exceptions that would be a traceback."""
    said = io.StringIO()
    complained = io.StringIO()
    before = sys.argv
    sys.argv = ['program', *arguments]
    code = 0
    try:
        with redirect_stdout(said), redirect_stderr(complained):
            main()
    except SystemExit as end:
        code = int(end.code or 0)
    finally:
        sys.argv = before
    return code, said.getvalue(), complained.getvalue()


def read_log() -> None:
    """Read a whole log in the same manner as replay."""
    parser = argparse.ArgumentParser()
    parser.add_argument('log', type=Path)
    cli.add_log_options(parser)

    def work(arguments: argparse.Namespace) -> None:
        log = cli.open_log(arguments.log, arguments)
        count = sum(1 for _ in log.events())
        print(count, log.skipped.count, log.skipped.first)

    cli.run(work, parser)


def check(path: Path, out: Path) -> str:
    """Repair a damaged file and read it, damaged and repaired; returns how it ended."""
    code, said, complained = ended(bag_repair.main, str(path), '-o', str(out))
    assert code in (0, 2), complained
    read_code, read_said, read_complained = ended(read_log, str(path))
    assert read_code in (0, 2), read_complained
    for line in (said, complained, read_said, read_complained):
        assert line.count('\n') <= 1 and len(line) < 1500, line
    if code == 2:
        assert not out.exists()
        assert read_code == 2
        return 'rejected'
    bag = Bag(out)
    assert not bag.is_truncated
    messages = list(bag.messages())
    assert said.startswith(f'{out}: {counted(len(messages), "message")} on ')
    out.unlink()
    return 'repaired' if read_code == 0 else 'repaired, not to be replayed'


def run_cases(whole: dict[str, bytes], folder: Path, seed: int, count: int) -> Counter[str]:
    """Check `count` damaged copies of each file."""
    ends: Counter[str] = Counter()
    for name, content in whole.items():
        rng = np.random.default_rng([seed, len(name)])
        for case in range(count):
            path = folder / 'damaged.mcap'
            path.write_bytes(damaged(content, rng))
            try:
                ends[check(path, folder / 'repaired.mcap')] += 1
            except BaseException as error:
                error.add_note(f'{name}: seed {seed}, case {case}')
                raise
    return ends
