"""JSON and YAML from untrusted files: bounded, no duplicate keys, every value of its declared type."""

from vjepa2_ac.storage.structured.json_text import (
    MOST_BYTES,
    json_list,
    json_object,
    read_json_list,
    read_json_object,
)
from vjepa2_ac.storage.structured.json_writing import finite_or_none, json_text, utc_now
from vjepa2_ac.storage.structured.messages import message_of, shown
from vjepa2_ac.storage.structured.nesting import MOST_DEPTH, require_shallow
from vjepa2_ac.storage.structured.patterns import require_quick
from vjepa2_ac.storage.structured.records import record_of
from vjepa2_ac.storage.structured.yaml_text import MOST_VALUES, parse_yaml

__all__ = [
    "MOST_BYTES",
    "MOST_DEPTH",
    "MOST_VALUES",
    "finite_or_none",
    "json_list",
    "json_object",
    "json_text",
    "message_of",
    "parse_yaml",
    "read_json_list",
    "read_json_object",
    "record_of",
    "require_quick",
    "require_shallow",
    "shown",
    "utc_now",
]
