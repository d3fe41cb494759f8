"""Many clips: lists of shots, who makes them, what became of each, plans for render farms.

Modules of the face:

    dataset  A data set of assets: an index in Parquet with a row per asset, and what its rows name as arrays
    engine   Shots made on this machine, each in a process of its own with its share of the cores, its memory and
             its time
    page     A thousand results on one page, which works offline: overlay and preview of each shot, the most
             doubtful first
    plans    Jobs for other schedulers: an Open Job Description template, a Slurm array script, or one command per
             line
    shots    Lists of shots: clips, folders of videos, or YAML with options of `make` for each
    state    What became of each shot: one small file beside its asset, and one lock while somebody makes it
    summary  How far a folder of shots is: counts, rate, failures by class; as text, JSON and CSV
"""

__all__ = ["dataset", "engine", "page", "plans", "shots", "state", "summary"]
