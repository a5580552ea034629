"""Write plan requests as aiperf reads them: python docs/examples/aiperf_inputs.py FILE [COUNT]"""

import json
import sys
from pathlib import Path

from looktwice.loadtests.bodies import make_calls
from looktwice.loadtests.mix import parse_mix
from looktwice.model.bundled import SCENES
from looktwice.model.driving.scene_store import read_scenes

kinds = parse_mix("direct", "1", "json", "none", 0).kinds(int((sys.argv[2:] or ["500"])[0]), seed=0)
calls = make_calls(tuple(read_scenes(SCENES, dense=False)), kinds, seed=0)
inputs = [{"session_id": str(place), "payloads": [json.loads(call.body)]} for place, call in enumerate(calls)]
Path(sys.argv[1]).write_text(json.dumps({"data": inputs}))
print(f"{sys.argv[1]}: {len(calls)} requests")
