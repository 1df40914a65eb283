"""The one ancestor of every error that a user can mend."""

from __future__ import annotations


class RelPoseError(Exception):
    """Its text is a sentence for the user: what was wrong, the value, what to do.

    Each module that refuses something derives its own exception from this one, so that a command
    prints the sentence and a defect of ours still shows its traceback.
    """
