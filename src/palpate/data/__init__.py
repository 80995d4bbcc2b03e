"""Data: the manifest, one file a data-set format, images and video frames."""
