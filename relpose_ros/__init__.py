"""Camera poses, and how far to trust them, from 2 to 8 views of one object (RelPose++, 3DV 2024)."""
