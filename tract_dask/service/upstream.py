"""The connections to Dask's dashboard."""

from __future__ import annotations

import httpcore  # noqa: F401  httpx would import it with its first client, while other threads import h11 and anyio
import httpx

from ..cluster.tls import web_context

_TIMEOUT = httpx.Timeout(60.0, connect=5.0)


class Upstream:
    """Connections to the dashboard, shared by all requests; opened with the first.

    Parameters
    ----------
    certificates
        Folder of those that the dashboard may use (setting tls).
    """

    def __init__(self, certificates: str | None = None) -> None:
        self.context = web_context(certificates)
        self._client: httpx.AsyncClient | None = None

    async def get(self, url: str, method: str, headers: dict[str, str]) -> httpx.Response:
        """Return a response whose body is still to come."""
        if self._client is None:
            self._client = httpx.AsyncClient(timeout=_TIMEOUT, trust_env=False, verify=self.context or True)
        return await self._client.send(self._client.build_request(method, url, headers=headers), stream=True)

    async def close(self) -> None:
        """Close the connections."""
        if self._client is not None:
            await self._client.aclose()
