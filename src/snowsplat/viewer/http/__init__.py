"""The server of all pages: `WebServer` answers with an ASGI app what its `Guard` accepts."""
