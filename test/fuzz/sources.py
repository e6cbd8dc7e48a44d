"""All sources of cases, by name."""

from fuzz import archives, core, files, heard, stream_nodes
from fuzz.cases import Source
from fuzz.offline import logs

_PARTS = (files, archives, heard, core, logs, stream_nodes)
SOURCES: dict[str, Source] = {source.name: source for part in _PARTS for source in part.SOURCES}
