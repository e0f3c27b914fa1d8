"""The commands of whoever runs the service: serve, token, certs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from ..settings.run import RunSettings
from .options import Command, setting_options
from .show import PATH, Subgroup, common_options, debug_option, show

data_root_option = click.option(
    "--data-root",
    type=PATH,
    required=True,
    envvar="TRACT_DASK_DATA_ROOT",
    show_envvar=True,
    help="Folder with the movies; results go there too.",
)

state_dir_option = click.option(
    "--state-dir",
    type=PATH,
    envvar="TRACT_DASK_STATE_DIR",
    show_envvar=True,
    help="Folder of the store of jobs and tokens; unset: one for this data root in ~/.local/state.",
)


@click.command(cls=Command)
@data_root_option
@state_dir_option
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on; others require tokens.")
@click.option("--port", default=8000, show_default=True, type=click.IntRange(0, 65535), help="Port; 0: a free one.")
@click.option("--concurrency", default=1, show_default=True, type=click.IntRange(1, 64), help="Jobs at the same time.")
@click.option("--certs", "certificates", type=PATH, help="Folder of tract-dask certs, for https.")
@click.option("--tokens", is_flag=True, help="Require tokens from users of this machine too.")
@click.option("--allowed-host", "allowed_hosts", multiple=True, metavar="NAME", help="Further host name; repeatable.")
@click.option("--trusted-proxy", default="", metavar="ADDRESS", help="Reverse proxy whose X-Forwarded headers count.")
@debug_option
@setting_options("cluster")
def serve(settings: RunSettings, **options: Any) -> None:
    """Serve jobs, their results and pages to watch them.

    Jobs and tokens are kept in the state folder, outside of the data root. After a stop or a crash, start it again:
    it continues every job.
    """
    from ..cluster.forkserver import uncollected  # which Windows has not

    with uncollected():
        from ..service import server
        from ..service.config import ServiceConfig

    server.serve(ServiceConfig(cluster=settings.cluster, **options), click.echo)


@click.group(cls=Subgroup)
def token() -> None:
    """Create, list and revoke tokens for the service.

    A running service applies every change at once.
    """


@token.command(name="create")
@click.argument("name")
@click.option(
    "--role", default="user", type=click.Choice(("admin", "user", "monitor")), help="Rights of the token. [user]."
)
@click.option("--file", type=PATH, help="Write the token to this file, readable by you only, and do not print it.")
@data_root_option
@state_dir_option
@common_options
def token_create(
    name: str, data_root: Path, state_dir: Path | None, *, role: str, file: Path | None, as_json: bool
) -> None:
    """Create a token for NAME, and show it once.

    A user submits jobs and changes their own; an admin changes all; a monitor reads health and metrics only.
    """
    from ..service.config import ServiceConfig
    from ..service.server import create_token

    made = create_token(ServiceConfig(data_root, state_dir=state_dir), name, role, file)
    show({"name": name, "role": role} | ({"wrote": str(file)} if file else {"token": made}), as_json=as_json)


@token.command(name="list")
@data_root_option
@state_dir_option
@common_options
def token_list(data_root: Path, state_dir: Path | None, *, as_json: bool) -> None:
    """List the tokens, the revoked ones too, without their secrets."""
    from ..service.config import ServiceConfig
    from ..service.server import list_tokens

    found = list_tokens(ServiceConfig(data_root, state_dir=state_dir))
    if as_json:
        click.echo(json.dumps([vars(item) for item in found]))
        return
    for item in found:
        click.echo(f"{item.id}  {item.role:<8} {item.name:<24} {item.created}  {_state(item.revoked)}".rstrip())
    if not found:
        click.echo("There are none. Make one with: tract-dask token create NAME")


@token.command(name="revoke")
@click.argument("name")
@data_root_option
@state_dir_option
@common_options
def token_revoke(name: str, data_root: Path, state_dir: Path | None, *, as_json: bool) -> None:
    """Revoke the token with the name or ID NAME; its sessions in browsers end at once."""
    from ..service.config import ServiceConfig
    from ..service.server import revoke_token

    revoked = revoke_token(ServiceConfig(data_root, state_dir=state_dir), name)
    show({"revoked": revoked.name, "id": revoked.id}, as_json=as_json)


@click.command()
@click.argument("folder", type=PATH, metavar="DIR")
@click.option("--host", "hosts", multiple=True, metavar="NAME", help="Name or address of a machine; may be repeated.")
@click.option("--days", default=825, show_default=True, type=click.IntRange(1, 3650), help="Validity of new ones.")
@common_options
def certs(folder: Path, hosts: tuple[str, ...], *, days: int, as_json: bool) -> None:
    """Make an authority and certificates for the service and for Dask in the folder DIR.

    Run it again to add a host, or to renew what has expired: the authority stays. Give the folder to serve with
    --certs, and for Dask's traffic with --tls.
    """
    from ..cluster.certificates import make_certificates

    found = make_certificates(folder, hosts, days=days)
    if as_json:
        rows = [{"file": str(item.path), "made": item.made, "expires": item.expires.isoformat()} for item in found]
        click.echo(json.dumps(rows))
        return
    for item in found:
        done = f"{'made' if item.made else 'kept'}, until {item.expires:%Y-%m-%d} ({item.days_left} days)"
        click.echo(f"{item.path}  {done}  {' '.join(item.hosts)}".rstrip())


def _state(revoked: str | None) -> str:
    return f"revoked {revoked}" if revoked else ""
