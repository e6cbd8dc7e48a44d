"""The published logs that the results are measured on, and how a file is known to be one of them.

benchmarks/data.md says where each is published.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from thinmap_ros.files.safe import PIECE_BYTES
from thinmap_ros.logs.readers.carmen import open_unpacked


@dataclass(frozen=True)
class PublishedLog:
    """A log by its name; sha256: of its text, unpacked."""

    name: str
    sha256: str


PUBLISHED = (
    PublishedLog('intel', 'ce69a97ee4ee644665343aafa10d60a31f549ee365b9c34d5d41e54be14542b0'),
    PublishedLog('intel_raw', '2b7c35b8df5f34a015faa496d06bd6f3b55eb5b77a865621b6e3ca94d7e117ec'),
    PublishedLog(
        'intel_sparse', 'add6eb50cd2d5cca9155d76a74c85fbebb928026401e0f4f31d80e93edf5bca0'
    ),
    PublishedLog('aces', '5bc8da2505b61cfe08cd035cb2d99ba7f41a2780b925b45c1f6c6570760c844c'),
    PublishedLog('aces_raw', 'c2a26a7eeefcb98aed6f3f447d2862919d06eb7ae4a13de0aeea28c1ddd9ec22'),
    PublishedLog('csail', '9f0be0c431f03c8a41e0b3fb81700a52b53edf0e3b5903dd809202995623f50c'),
    PublishedLog('csail_raw', '59d32be85266f04479b4a0ac5ff2ed8912d644b70848c88d8ea73c418d6ddb37'),
    PublishedLog('fhw', 'e94e72e2cbfc2b3c1efec275f1aa2333ae97c3e9e9fbb52d92cf8c65bae71b76'),
    PublishedLog('sena', '4abf5634b6bfc4fc30c6c499b28e5a2a47b6571e961c2fba20a1f8c7ed352f31'),
    PublishedLog('mrpt_office', 'c8755feae81e4a4b4a4522e43312404fb0cc429a686401515217cdd2c1b6aa5f'),
)


def unpacked_sha256(path: Path) -> str:
    """SHA-256 of the text of a log, plain or gzip, in hexadecimal digits.

    Raises OSError or EOFError where it cannot be read to its end.
    """
    together = hashlib.sha256()
    with open_unpacked(path) as stream:
        while piece := stream.read(PIECE_BYTES):
            together.update(piece)
    return together.hexdigest()
