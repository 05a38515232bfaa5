"""Regular expressions from a config, matched in a process that can be killed, so that none runs for ever."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence

from vjepa2_ac.errors import InputError

LONGEST_S = 20.0  # for all texts together; 100,000 take a tenth of a second
LONGEST_TEXT = 4096  # letters

# Python's engine backtracks, for `(a+)+b` practically for ever, and cannot be interrupted in a thread.
_MATCH = """
import json, re, sys
pattern, texts = json.load(sys.stdin)
search = re.compile(pattern).search
json.dump([found.group(1) if (found := search(text)) else None for text in texts], sys.stdout)
"""


def first_groups(pattern: str, texts: Sequence[str], *, where: str) -> list[str | None]:
    """Return the match of a pattern's one group in each text; None if there is none.

    Args:
        pattern: A regular expression that compiles and has one group.
        texts: To search in.
        where: The origin of the pattern, for messages.

    Raises:
        InputError: It takes too long, or fails in another way.
    """
    asked = json.dumps([pattern, [text[:LONGEST_TEXT] for text in texts]])
    command = [sys.executable, "-I", "-S", "-c", _MATCH]
    try:
        done = subprocess.run(command, input=asked, capture_output=True, timeout=LONGEST_S, check=True, text=True)  # noqa: S603 - our own code
    except subprocess.TimeoutExpired:
        found = f"not done with {len(texts)} identities after {LONGEST_S:g} s"
        fix = "Write it without repetitions within repetitions, such as (a+)+"
        raise InputError(where=where, found=found, needed="a pattern that matches at once", fix=fix) from None
    except subprocess.CalledProcessError as error:
        reason = error.stderr.strip().splitlines()[-1:] or [f"status {error.returncode}"]
        found = f"cannot be matched ({reason[0][:200]})"
        raise InputError(where=where, found=found, needed="a simple pattern") from None
    return list(json.loads(done.stdout))
