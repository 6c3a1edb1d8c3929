"""The version of hololoop that runs."""

from __future__ import annotations


def installed_version() -> str:
    """Version of the installed distribution; "unknown" where hololoop runs from its sources without installation."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("hololoop")
    except PackageNotFoundError:
        return "unknown"
