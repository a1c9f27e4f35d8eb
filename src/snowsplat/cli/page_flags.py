"""The flags `--view`, `--port`, `--host` and `--allow-host`: a page in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from snowsplat.cli.flags import flag
from snowsplat.util.errors import UserError

if TYPE_CHECKING:
    from snowsplat.pipeline.run.live_page import LivePage

AllowHost = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, flag("NAME")]


@dataclass(frozen=True)
class PageFlags:
    """The address of the page."""

    port: int | None = None
    host: str | None = None
    allow_host: tuple[str, ...] = ()

    def page(self, view: bool = True) -> LivePage | None:
        """The page, not yet open; None without ``view``.

        Raises:
            UserError: a port or host without a page, or one that cannot be used.
        """
        if view:
            from snowsplat.pipeline.run.live_page import LivePage

            return LivePage(self.port, self.host, self.allow_host)
        given = {
            "--port": self.port is not None,
            "--host": self.host is not None,
            "--allow-host": bool(self.allow_host),
        }
        for name in given:
            if given[name]:
                raise UserError(f"{name} sets the address of a page; add --view to open one")
        return None
