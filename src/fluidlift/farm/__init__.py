"""Many clips: lists of shots, who makes them, what became of each, plans for render farms.

`shots` reads what is to be made, `state` keeps what became of each shot beside its asset, `engine` makes them on this
machine, `plans` writes jobs for other schedulers, `summary` and `page` tell how far a folder is.
"""
