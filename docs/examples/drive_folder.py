"""Write a bundled scene as a recorded drive: python docs/examples/drive_folder.py FOLDER"""

import csv
import sys
from pathlib import Path

from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene import CLIP_PERIOD_S
from looktwice.model.driving.scene_store import read_scenes
from looktwice.model.driving.trajectory import STEP_S

labelled = next(iter(read_scenes(SCENES, dense=False)))
pictures = Path(sys.argv[1]) / "dash"
pictures.mkdir(parents=True)
for number, picture in enumerate(labelled.scene.clips[0].images):
    (pictures / f"{number * CLIP_PERIOD_S:.3f}.jpg").write_bytes(picture)
with (pictures.parent / "poses.csv").open("w", newline="") as file:
    rows = csv.writer(file)
    rows.writerow(["time_s", "x_m", "y_m", "heading_rad"])
    for step, (x_m, y_m, _, heading_rad) in enumerate([*labelled.scene.history, *labelled.future]):
        rows.writerow([f"{step * STEP_S:.3f}", x_m, y_m, heading_rad])
print(f"{pictures.parent}: 4 pictures, {step + 1} poses")
