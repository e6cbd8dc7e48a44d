"""Message types as bags carry them along."""

from mcap.records import Schema
from rosbags.typesys import get_types_from_idl, get_types_from_msg
from rosbags.typesys.store import Typestore


def learn(typestore: Typestore, schema: Schema) -> None:
    """Take the types of a schema into a typestore, where they are not known. Raises rosbags' errors."""
    if schema.name in typestore.types:
        return
    text = schema.data.decode()
    types = get_types_from_idl(text) if 'idl' in schema.encoding else get_types_from_msg(text, schema.name)
    typestore.register({name: kind for name, kind in types.items() if name not in typestore.types})
