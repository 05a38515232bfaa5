"""An old name of `vjepa2_ac.media.image_file`, for one release: scripts of version 0.1 import it."""

import warnings

from vjepa2_ac.media.image_file import read_image as read_picture

__all__ = ["read_picture"]

warnings.warn("vjepa2_ac.data.picture_file is vjepa2_ac.media.image_file now: read_image", FutureWarning, stacklevel=2)
