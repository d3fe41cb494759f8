"""The asset in the browser: look at it, change it, see the change, hand it on.

`app` puts the page together; `frames`, `footage`, `timeline`, `controls`, `draft`, `jobs`, `mesh_files`, `surfacing`
and `ports` know no browser.
"""
