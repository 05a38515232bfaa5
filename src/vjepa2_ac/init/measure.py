"""How many episodes a data set has and how long they are: by its index, which training needs anyway."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vjepa2_ac import storage
from vjepa2_ac.config.loading import config_from
from vjepa2_ac.data.index.episode_table import EpisodeTable
from vjepa2_ac.data.sources.registry import open_source
from vjepa2_ac.episode import Progress
from vjepa2_ac.errors import UserError
from vjepa2_ac.init.found import FoundData
from vjepa2_ac.init.knob import plain
from vjepa2_ac.places import BUILTIN

_MOST_ARE_LONGER = 0.1  # quantile


def measured(found: FoundData, progress: Progress | None = None) -> FoundData:
    """Return what was found with the numbers of the index; unchanged behind a URL, or where it cannot be built.

    Why it cannot, the check of the data says.
    """
    if storage.is_url(found.path):
        return found
    data = {"source": found.source, "path": found.path, "states": found.states, **plain(found.knobs)}
    values = {"run_dir": "none", "data": data, "model": {"base": f"{BUILTIN}sim-tiny"}}
    try:
        source = open_source(config_from(values, where="vjepa2-ac init").data)
        lengths = EpisodeTable.of(source.infos(progress)).num_steps
    except UserError:
        return found
    if not len(lengths):
        return found
    return replace(
        found,
        episodes=len(lengths),
        steps=int(lengths.sum()),
        usual_steps=int(np.median(lengths)),
        short_steps=int(np.quantile(lengths, _MOST_ARE_LONGER)),
    )
