"""Options of the command line, made from the declarations of the settings: one declaration, one name, one sentence."""

from __future__ import annotations

import dataclasses
import functools
import operator
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click

from ..errors import SettingsError
from ..settings import declare, toml
from ..settings.declare import Settings
from ..settings.run import TITLES, RunSettings

F = TypeVar("F", bound=Callable[..., Any])

IMPLIED = {("columns", "csv"): "csv", ("columns", "lattices"): "lattice", ("drift", "csv"): "csv"}
"""Settings that say which method is meant where none is given."""

ALL = "tract_dask.all_options"
"""Key of click's context under which ``--help-all`` is kept."""


def numbers(text: str) -> tuple[int, ...]:
    """Return whole numbers that have commas between them.

    Examples
    --------
    >>> numbers("0,64,0,64")
    (0, 64, 0, 64)
    """
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise click.BadParameter(
            f"{text!r} is not whole numbers with commas between them, such as 0,64,0,64"
        ) from error


class SettingOption(click.Option):
    """An option for a setting: its heading in the help, and whether ``--help`` lists it or only ``--help-all``."""

    def __init__(self, *args: Any, heading: str, common: bool = True, **more: Any) -> None:
        super().__init__(*args, **more)
        self.heading = heading
        self.common = common


class Command(click.Command):
    """A command whose help lists its common options, or all, under the headings of their groups."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, group by group."""
        sections: dict[str, list[tuple[str, str]]] = {"Options": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx) if isinstance(parameter, click.Option) else None
            if record and (ALL in ctx.meta or getattr(parameter, "common", True)):
                sections.setdefault(getattr(parameter, "heading", "Options"), []).append(record)
        for heading, records in sections.items():
            with formatter.section(heading):
                formatter.write_dl(records)


def _show_all(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    if value:
        ctx.meta[ALL] = True
        click.echo(ctx.get_help())
        ctx.exit()


_FILE = click.Path(dir_okay=False, path_type=Path)

_CONFIG = "Settings to start from, such as the run.toml of an earlier run; options override them."
_SET = "Set any setting (docs/settings.md), such as fit.window_px=31 or fit.vacuum_box=unset; repeatable."
_HELP_ALL = "Show all options, not only the common ones, and exit."

_COLLECTING = (
    click.option("--help-all", is_flag=True, is_eager=True, expose_value=False, callback=_show_all, help=_HELP_ALL),
    click.option("--set", "assignments", multiple=True, metavar="GROUP.NAME=VALUE", help=_SET),
    click.option("--config", type=_FILE, help=_CONFIG),
)
"""The options for settings of all groups, last to first."""


def setting_options(*groups: str) -> Callable[[F], F]:
    """Give a command an option for every setting of ``groups``, ``--config`` and ``--set``.

    It receives them as ``settings``. A group is named as in :class:`RunSettings`; ``group.name`` is one setting of it.
    """

    def decorate(function: F) -> F:
        @functools.wraps(function)
        def command(*args: Any, config: Path | None, assignments: tuple[str, ...], **values: Any) -> Any:
            given = {name: values.pop(name) for name in list(values) if "__" in name}
            settings = collect(given, config, values.pop("cluster_file", None), _assigned(assignments, groups))
            return function(*args, settings=settings, **values)

        decorated: Any = command
        for group in reversed(groups):
            for option in reversed(_group_options(group)):
                decorated = option(decorated)
        for option in _COLLECTING:
            decorated = option(decorated)
        return typing.cast("F", decorated)

    return decorate


def class_options(
    kind: type[Settings],
    name: str,
    heading: str,
    *,
    presets: Mapping[str, Settings] | None = None,
    without: tuple[str, ...] = (),
) -> Callable[[F], F]:
    """Give a command an option for every setting of a class that is no part of a run's settings.

    Parameters
    ----------
    kind, name
        The class, and the argument in which the command receives an instance.
    heading
        Of the options in the help.
    presets
        Instances to choose from with ``--preset``, the first by default; options override what it says.
    without
        Settings that get no option.
    """
    fields = [field for field in _fields(kind) if field[0].name not in without]

    def decorate(function: F) -> F:
        @functools.wraps(function)
        def command(*args: Any, **values: Any) -> Any:
            start = presets[values.pop("preset")] if presets else kind()
            given = {item.name: values.pop(f"{name}__{item.name}") for item, _ in fields}
            changes = {option: value for option, value in given.items() if value is not None}
            return function(*args, **{name: dataclasses.replace(start, **changes)}, **values)

        decorated: Any = command
        for field in reversed(fields):
            decorated = _option(name, field, heading)(decorated)
        if presets:
            first, *_ = presets
            text = f"The settings to start from; the options below override them. [{first}]."
            more = {"type": click.Choice(tuple(presets)), "default": first, "help": text}
            decorated = click.option("--preset", cls=SettingOption, heading=heading, **more)(decorated)
        return typing.cast("F", decorated)

    return decorate


def collect(
    given: dict[str, Any],
    config: Path | None = None,
    cluster_file: Path | None = None,
    assigned: Mapping[tuple[str, ...], Any] | None = None,
) -> RunSettings:
    """Return the settings in the file ``config``, or the defaults, with those options in their place that were given.

    Parameters
    ----------
    given
        Values by ``group__name``; None where the option was not given.
    config
        A TOML file.
    cluster_file
        A TOML file of the cluster's settings alone, which replaces what ``config`` says of it.
    assigned
        Values by path, which override all others; None unsets.

    Raises
    ------
    SettingsError
        Where a value is out of range, or the file cannot be used.

    Examples
    --------
    >>> collect({"columns__csv": "seeds.csv", "columns__method": None}).columns.method
    'csv'
    """
    settings = toml.load(config) if config else RunSettings()
    if cluster_file:
        settings = dataclasses.replace(settings, cluster=toml.load_cluster(cluster_file))
    if given.pop("drift__off", False):
        given["drift__method"] = "none"
    changes: dict[tuple[str, ...], Any] = {
        tuple(name.split("__")): value for name, value in given.items() if value is not None
    }
    changes |= assigned or {}
    implied = {(path[0], "method"): method for path, method in IMPLIED.items() if changes.get(path) is not None}
    values = toml.to_dict(settings)
    for (*groups, name), value in (implied | changes).items():
        table = functools.reduce(operator.getitem, groups, values)
        if value is None:
            table.pop(name, None)
        else:
            table[name] = value
    return toml.from_dict(RunSettings, values)


def _assigned(texts: tuple[str, ...], groups: tuple[str, ...]) -> dict[tuple[str, ...], Any]:
    """Return what ``--set`` gave, by path.

    Raises
    ------
    SettingsError
        Where it cannot be read, or is not of the ``groups`` that the command uses.
    """
    found = dict(map(toml.assigned, texts))
    for path in found:
        if not {path[0], ".".join(path[:2])} & set(groups):
            what, remedy = "this command does not use the setting", "Leave it out, or set it with tract-dask run"
            raise SettingsError(what, "--set", f"a setting of {', '.join(groups)}", ".".join(path), remedy)
    return found


def _group_options(name: str) -> list[Callable[[Any], Any]]:
    group, _, only = name.partition(".")
    kinds = typing.get_type_hints(RunSettings)
    heading = TITLES[group]
    fields = [field for field in _fields(kinds[group]) if only in ("", field[0].name)]
    options = [_option(group, field, heading, common=bool(only) or field[0].metadata["common"]) for field in fields]
    if name == "drift":
        more = {"is_flag": True, "help": "Same as --drift-method none."}
        options.append(
            click.option("--no-drift", "drift__off", cls=SettingOption, heading=heading, common=False, **more)
        )
    if name == "cluster":
        text = "TOML file of the cluster: SLURM, ssh and more (docs/deploy.md); options override it."
        more = {"type": _FILE, "help": text}
        options.insert(0, click.option("--cluster", "cluster_file", cls=SettingOption, heading=heading, **more))
    return options


def _fields(kind: type[Settings]) -> list[tuple[dataclasses.Field[Any], Any]]:
    """Return the settings of a class that have an option, with their types."""
    kinds = typing.get_type_hints(kind)
    return [(field, kinds[field.name]) for field in dataclasses.fields(kind) if not field.metadata["in_files_only"]]


def _option(
    group: str, field: tuple[dataclasses.Field[Any], Any], heading: str, *, common: bool = True
) -> Callable[[Any], Any]:
    item, annotation = field
    meta = item.metadata
    flag = declare.option(group, item)
    plain = declare.plain_type(annotation)
    more: dict[str, Any] = {}
    if plain is bool:
        flag = f"{flag}/--no-{flag[2:]}"
        default = "on" if item.default else "off"
    else:
        default = "" if item.default in (None, ()) else f"{item.default:g}" if plain is float else f"{item.default}"
        more["type"] = click.Choice(meta["choices"]) if meta["choices"] else lambda text: toml.value(text, annotation)
        more["metavar"] = None if meta["choices"] else _metavar(item.name, plain, annotation, meta["unit"])
    text = meta["description"] + (f" [{default}]" if default else "") + "."
    more |= {"help": text, "heading": heading, "common": common}
    return click.option(flag, f"{group}__{item.name}", default=None, cls=SettingOption, **more)


def _metavar(name: str, plain: Any, annotation: Any, unit: str) -> str:
    if plain is tuple:
        return "LIST" if Any in typing.get_args(annotation) else "N,N,..."
    if name.endswith(("csv", "file")):
        return "FILE"
    return unit.upper() if unit else {int: "N", float: "NUMBER", str: "TEXT"}[plain]
