"""Classes that users derive from: a misspelt method would have no effect, without a word."""

import logging
from difflib import get_close_matches

logger = logging.getLogger(__name__)


def check_overrides(cls: type, base: type) -> None:
    """Warn of methods that have nearly a name of ``base``, such as "regulariser"."""
    public = [name for name in vars(base) if name[0] != "_"]
    inherited = [name for name in public if getattr(cls, name, None) is getattr(base, name)]
    for own in [name for name, value in vars(cls).items() if callable(value) and name[0] != "_"]:
        if meant := get_close_matches(own, inherited, 1, 0.85):
            logger.warning("a training calls %s, not %s.%s", meant[0], cls.__name__, own)
