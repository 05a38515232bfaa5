"""Images and video: how are they decoded and written? JPEG, image files, MP4."""
