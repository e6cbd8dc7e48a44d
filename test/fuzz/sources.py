"""All sources of cases, by name."""

from fuzz import archives, core, files, heard
from fuzz.cases import Source

SOURCES: dict[str, Source] = {
    source.name: source
    for source in (*files.SOURCES, *archives.SOURCES, *heard.SOURCES, *core.SOURCES)
}
