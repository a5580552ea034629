"""Drive a car in MetaDrive, and film it: python docs/examples/drive_metadrive.py [--service URL]

Needs the simulator (`make sim`). `looktwice drive` does the same for many episodes, and compares drivers.
"""

import argparse
from pathlib import Path

from looktwice.clients import PlannerClient
from looktwice.clients.metadrive.closed_loop import DriveConfig, Film, Rig, ServicePilot, drive
from looktwice.clients.wire import Controls

parser = argparse.ArgumentParser()
parser.add_argument("--service", default="http://127.0.0.1:8000")
parser.add_argument("--film", type=Path, default=Path("drive.gif"))
parser.add_argument("--seconds", type=float, default=20.0)
asked = parser.parse_args()

film = Film()
with PlannerClient(asked.service) as planner:
    rig = Rig.of_width(planner.models()[0].image_size[0])
    pilot = ServicePilot(planner, "looktwice", Controls(n=6))
    drove = drive(600_000, pilot, rig, DriveConfig(asked.seconds), film.add)
rig.close()
film.save(asked.film)
print(f"{drove.driven_m:.0f} m with {drove.plans} plans, ended by {drove.ended}; see {asked.film}")
