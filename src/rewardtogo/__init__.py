"""rewardtogo."""
