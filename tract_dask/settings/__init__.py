"""All settings: declared once, read and written as TOML."""

from .cluster import ClusterSettings, SlurmSettings, SshSettings
from .declare import Settings
from .run import (
    ColumnSettings,
    ConvertSettings,
    DriftSettings,
    FitSettings,
    MetadataSettings,
    RunSettings,
    SourceSettings,
)
from .toml import from_dict, from_toml, load, load_cluster, to_dict, to_toml

__all__ = [
    "ClusterSettings",
    "ColumnSettings",
    "ConvertSettings",
    "DriftSettings",
    "FitSettings",
    "MetadataSettings",
    "RunSettings",
    "Settings",
    "SlurmSettings",
    "SourceSettings",
    "SshSettings",
    "from_dict",
    "from_toml",
    "load",
    "load_cluster",
    "to_dict",
    "to_toml",
]
