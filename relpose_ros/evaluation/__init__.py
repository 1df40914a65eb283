"""Metrics, baselines and protocol of RelPose++'s evaluation."""
