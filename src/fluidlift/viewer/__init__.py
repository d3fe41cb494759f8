"""The asset in the browser: look at it, change it, see the change, hand it on.

`app` puts the page together; `frames`, `footage`, `timeline`, `controls`, `draft`, `jobs`, `mesh_files`, `surfacing`
and `ports` know no browser.

Modules of the face:

    app  The page put together: one thread draws, the panels only say what is wanted
"""

__all__ = [
    "app",
]  # fmt: skip
