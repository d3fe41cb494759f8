"""`fluidlift view`: an asset in the browser."""

from __future__ import annotations

from fluidlift.cli.options import Asset
from fluidlift.cli.quantities import command


@command
class View:
    """Look at an asset in the browser, change it and see the change."""

    asset: Asset
    """folder of the asset"""
    host: str = "127.0.0.1"
    """address to listen on; any other than this machine's own lets the network in"""
    port: int = 8080
    """of the page; the next free one where it is in use"""
    browser: bool = False
    """open the page in the default browser"""


def run(wanted: View) -> int:
    """Show the asset until Ctrl-C; the exit code."""
    from fluidlift.viewer.app import ViewRequest, view_asset

    request = ViewRequest(wanted.host, wanted.port, wanted.browser)
    view_asset(wanted.asset, request, told=lambda line: print(line, flush=True))
    return 0
