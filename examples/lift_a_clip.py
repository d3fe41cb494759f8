"""Lift a clip: a video in, an asset out, and what was fitted with how sure it is.

    python examples/lift_a_clip.py [CLIP [OUT.fluid [SETTING=VALUE ...]]]

Without a clip it takes the shipped one (a minute). Settings are those of `fluidlift make --set`.
"""

import sys
from pathlib import Path

import fluidlift as fl
from fluidlift.synthetic.demo import demo_clip

arguments = sys.argv[1:]
clip = Path(arguments[0]) if arguments else demo_clip()
folder = Path(arguments[1]) if len(arguments) > 1 else Path(clip.stem + ".fluid")
config = fl.build_config("draft", overrides=arguments[2:])

made = fl.make(fl.Inputs(clip), folder, config)  # a run that was stopped goes on where it was
asset = fl.load_asset(made.folder)

print(f"{asset.kind}: {len(asset.rest)} Gaussians, {made.frames} simulated frames, {made.seconds:.0f} s")
for name, e in asset.estimates.items():
    known = f"± {e.sigma:.2g}" if e.fitted else "(prior: the clip does not tell)"
    print(f"  {name:22} {e.value:10.3g} {e.unit} {known}")
for text in made.warnings:
    print("warning:", text)
print(f"watch {folder}/preview.mp4, open {folder}/report.html")
