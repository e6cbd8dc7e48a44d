"""Repairs a truncated or damaged bag (MCAP): writes a new bag of all intact messages."""

import argparse
from pathlib import Path

from thinmap_ros.core.errors import InputError, counted
from thinmap_ros.logs.bag_writer import temporary_bag
from thinmap_ros.logs.repair import RepairReport, repair
from thinmap_ros.logs.storage import bag_files, kind_of, mcap_files_in, refuse_foreign
from thinmap_ros.tools import cli
from thinmap_ros.tools.arguments import Parser


def files_of(bag: Path) -> list[Path]:
    """Return the MCAP files of a bag, in the order of recording.

    Raises InputError if it has none.
    """
    refuse_foreign(bag, 'an MCAP file')
    files = mcap_files_in(bag) if bag.is_dir() else [bag]
    if not any(f.is_file() and (f.suffix == '.mcap' or kind_of(f) == 'mcap') for f in files[:1]):
        raise InputError(f'{bag}: expected an MCAP file, or a folder with MCAP files in it')
    return files


def _has_compressed_messages(bag: Path) -> bool:
    """Whether messages are compressed individually, by metadata.yaml; False without it."""
    try:
        return bag_files(bag).compressed_messages
    except InputError:
        return False


def describe_repair(found: RepairReport) -> str:
    """Describe the repair in one line."""
    messages = counted(sum(found.counts.values()), 'message')
    parts = [f'{messages} on {counted(len(found.counts), "topic")}']
    if found.first_ns is not None:
        parts[0] += f', {(found.last_ns - found.first_ns) / 1e9:.1f} s'
    parts.extend(f'{file.name}: {damage}' for file, damage in found.damage.items() if damage)
    if found.unreadable:
        parts.append(f'{counted(found.unreadable, "message")} that cannot be decompressed')
    return '; '.join(parts)


def _work(arguments: argparse.Namespace) -> None:
    bag: Path = arguments.bag
    out: Path = arguments.out or bag.with_name(f'{bag.stem}_repaired')
    files = files_of(bag)
    if out.resolve() == bag.resolve():
        raise InputError(f'{out}: expected another name than that of the bag itself')
    with temporary_bag(out) as folder:
        found = repair(files, folder, _has_compressed_messages(bag))
    print(f'{out}: {describe_repair(found)}')


def main() -> None:
    """Run the program."""
    parser = Parser('bag_repair', __doc__)
    parser.add_argument('bag', type=Path, help='MCAP file, or rosbag2 folder of MCAP files')
    parser.add_argument(
        '-o', '--out', type=Path, help='folder or .mcap file to write (default: BAG_repaired)'
    )
    cli.run(_work, parser)


if __name__ == '__main__':
    main()
