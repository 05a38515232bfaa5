"""JSON and YAML from untrusted files: bounded, no duplicate keys, every value of its declared type."""

from vjepa2_ac.storage.structured.json_text import MOST_BYTES, json_list, json_object, read_json_object
from vjepa2_ac.storage.structured.json_writing import finite_or_none, json_text, utc_now
from vjepa2_ac.storage.structured.messages import message_of, shown
from vjepa2_ac.storage.structured.nesting import MOST_DEPTH, require_shallow
from vjepa2_ac.storage.structured.patterns import require_quick
from vjepa2_ac.storage.structured.records import record_of
from vjepa2_ac.storage.structured.yaml_text import MOST_VALUES, parse_yaml
