"""Many clips: lists of shots, who makes them, what became of each, plans for render farms.

Modules of the face:

    cuts         A clip of several shots becomes several shots: its cuts are found, and each part is a shot of its
                 own
    dataset      A data set of assets: an index in Parquet with a row per asset, and what its rows name as arrays
    engine       Who makes shots: the seam behind which processes of this machine and a cluster are alike
    guard        A make ends with who started it, also where that was killed: nobody would take what it makes, or
                 count its memory
    local        The engine of one machine: a process per shot, some at a time
    page         A thousand results on one page, which works offline: overlay and preview of each shot, the most
                 doubtful first
    plans        Jobs for other schedulers: an Open Job Description template, a Slurm array script, or one command
                 per line
    ray_cluster  The engine of many machines: a task of Ray per shot, on one machine or on a cluster that is there
    shots        Lists of shots: clips, folders of videos, or YAML with options of `make` for each
    state        What became of each shot: one small file beside its asset, and one lock while somebody makes it
    store        Assets on an object store, or on anything else that fsspec reaches by a URL such as
                 s3://bucket/assets
    summary      How far a folder of shots is: counts, rate, failures by class; as text, JSON, CSV and Parquet
"""

__all__ = [
    "cuts",
    "dataset",
    "engine",
    "guard",
    "local",
    "page",
    "plans",
    "ray_cluster",
    "shots",
    "state",
    "store",
    "summary",
]
