"""Classes that users derive from: a misspelt method is an error, instead of having no effect."""

from difflib import get_close_matches

from snowsplat.util.errors import UserError


def check_overrides(cls: type, base: type) -> None:
    """Raises: UserError: a method has nearly a name of ``base``, such as "regulariser"."""
    public = [name for name in vars(base) if name[0] != "_"]
    inherited = [name for name in public if getattr(cls, name, None) is getattr(base, name)]
    for own in [name for name, value in vars(cls).items() if callable(value) and name[0] != "_"]:
        if meant := get_close_matches(own, inherited, 1, 0.85):
            named = f"{cls.__name__}.{own}"
            raise UserError("{name} is never called; {meant} is", name=named, meant=meant[0])
