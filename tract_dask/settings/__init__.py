"""All settings: declared once, read and written as TOML."""
