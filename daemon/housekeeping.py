"""What has to be done beside the frames: keep the disk's quota, back up the changes, count what there is."""

from __future__ import annotations
