"""The flags `--view`, `--port` and `--host`: a page in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.pipeline.run.live_page import LivePage


@dataclass(frozen=True)
class PageFlags:
    """The address of the page."""

    port: int | None = None
    host: str | None = None

    def page(self, view: bool = True) -> LivePage | None:
        """The page, not yet open; None without ``view``.

        Raises:
            UserError: a port or host without a page, or one that cannot be used.
        """
        if view:
            from snowsplat.pipeline.run.live_page import LivePage

            return LivePage(self.port, self.host)
        for name, value in (("--port", self.port), ("--host", self.host)):
            if value is not None:
                raise UserError(f"{name} sets the address of a page; add --view to open one")
        return None
