"""Message types as bags carry them along."""

from functools import lru_cache

from mcap.records import Schema
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

LARGEST_SCHEMA = 2**20
"""Bytes of the definition of a message type with all that it is made of."""
_IDL_SEPARATOR = '=' * 80 + '\n'


def typestore_of(schema: Schema) -> Typestore:
    """Types to decode messages of a schema with: its own, or ROS 2 Jazzy's where these do not do.

    That is where a definition cannot be read, lacks a type that it is made of, or lacks fields of a
    type that Jazzy knows.
    """
    known = get_typestore(Stores.ROS2_JAZZY)
    try:
        own = own_typestore(schema)
        own.hash_rihs01(schema.name)  # raises where a type is missing
    except Exception:  # rosbags' parser raises whatever a broken definition makes it stumble over
        return known
    for name in own.fielddefs.keys() & known.fielddefs.keys():
        fields = own.fielddefs[name][1]
        if not all(field in fields for field in known.fielddefs[name][1]):
            return known
    return own


def own_typestore(schema: Schema) -> Typestore:
    """Types of one schema. Raises what rosbags' parser raises, and ValueError if too large."""
    if len(schema.data) > LARGEST_SCHEMA:
        raise ValueError(f'definition of {len(schema.data)} bytes: expected {LARGEST_SCHEMA}')
    return _parsed(schema.name, schema.encoding, schema.data.decode())


@lru_cache(maxsize=64)
def _parsed(name: str, encoding: str, text: str) -> Typestore:
    typestore = get_typestore(Stores.EMPTY)
    if 'idl' not in encoding:
        typestore.register(get_types_from_msg(text, name))
        return typestore
    # rosbag2 puts the files that a type needs one behind the other, each below its name.
    parts = [part.partition('\n')[2] for part in text.split(_IDL_SEPARATOR)[1:]]
    for part in parts or [text]:
        types = get_types_from_idl(part)
        unknown = types.keys() - typestore.types.keys()
        typestore.register({name: types[name] for name in unknown})
    return typestore
