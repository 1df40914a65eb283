"""The network of RelPose++ and our compact one: the same modules under two presets."""
