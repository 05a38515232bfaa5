"""Images and video, decoded and written: JPEG, image files, MP4."""
