"""`studio_app`: the requests of the page of the studio.

The tables `ROUTES` say what is answered where. Answers are JSON; an error is
``{"error": {"en": …, "zh": …}}``, one line for people. A scene has the address /scenes/NAME.
"""

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.routing import Route, WebSocketRoute

from snowsplat.studio import library_requests, picture_requests, result_requests, scene_requests
from snowsplat.studio.library import Library
from snowsplat.studio.requests import SceneAnswer, Studio, answering

#: The content security policy of the page.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "media-src 'self'; connect-src 'self'; frame-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)


def studio_app(library: Library, addresses: Callable[[], list[str]]) -> Starlette:
    """The app. ``addresses``: the URLs of the page for other machines."""
    studio = Studio(library, addresses)
    files = library_requests.page_files()
    page = [Route(f"/{name}", partial(library_requests.page, studio)) for name in files]
    images = WebSocketRoute(
        "/scenes/{name}/live/live", partial(result_requests.live_images, studio)
    )
    whole = [
        Route(path, answering(partial(answer, studio)), methods=[method])
        for path, method, answer in library_requests.ROUTES
    ]
    scenes = [
        Route(f"/scenes/{{name}}{path}", answering(_of_scene(studio, answer)), methods=[method])
        for topic in (scene_requests, picture_requests, result_requests)
        for path, method, answer in topic.ROUTES
    ]
    app = Starlette(routes=[*page, images, *whole, *scenes])
    app.router.redirect_slashes = False  # the address would lack the token
    return app


def _of_scene(studio: Studio, answer: SceneAnswer) -> Callable[[Request], Awaitable[Any]]:
    async def find(request: Request) -> Any:
        return await answer(studio, request, studio.library.find(request.path_params["name"]))

    return find
