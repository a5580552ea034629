"""What makes a checkpoint folder a model repository of Hugging Face: model card, processor, chat template.

``auto_map`` names two small files in the folder, which import this package. With ``trust_remote_code=True``,
`AutoModel` and `AutoProcessor` load the whole network by them; the backbone's own class would leave out the
encoders.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from looktwice.model.families.family import Family
from looktwice.model.families.registry import family_named
from looktwice.model.families.trajectory_codes import CODES, TRAJECTORY
from looktwice.model.formats.pieces import Codes, walk
from looktwice.model.network.card import CheckpointError, read_card, update_card
from looktwice.model.network.chat_prompt import chat_template
from looktwice.model.network.processor import LookTwiceProcessor, processor_config
from looktwice.model.network.vla import LookTwiceVla
from looktwice.model.network.vla_settings import CONFIG_KEY, SettingsError, VlaSettings

CARD: Final = "README.md"
_MODEL_CODE: Final = "modeling_looktwice"
_PROCESSOR_CODE: Final = "processing_looktwice"
_AUTO_MODELS: Final = ("AutoModel", "AutoModelForImageTextToText", "AutoModelForMultimodalLM")
_CODE: Final = '''"""{what} of this checkpoint, from the package `looktwice`, which has to be installed."""

from {module} import {name} as _{name}


class {name}(_{name}):
    """As the package has it."""
'''


def write_repository(
    folder: Path,
    figures: Mapping[str, str] | None = None,
    *,
    name: str | None = None,
    formats: Sequence[str] | None = None,
) -> None:
    """Add to a checkpoint folder, or renew in it, what a model repository needs; weights stay as they are.

    Args:
        folder: with ``config.json``, tokenizer, weights and ``looktwice.json``.
        figures: measured values by what was measured, kept in ``looktwice.json``; None keeps what is there.
        name: what the checkpoint is called from now on; None keeps its name.
        formats: which of its formats it is for, the first one its default; None keeps all.

    Raises:
        CheckpointError: the folder is no checkpoint, or does not write one of ``formats``.
    """
    read_card(folder)
    path = folder / "config.json"
    try:
        config: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        extra = {name: value for name, value in config[CONFIG_KEY].items() if not name.endswith("_token_id")}
        settings = VlaSettings.from_dict(extra)
    except (OSError, ValueError, KeyError, AttributeError, SettingsError) as error:
        raise CheckpointError(f"{path} is no configuration of ours: {error}") from error
    kept = settings.formats if formats is None else tuple(formats)
    if not kept or (unknown := set(kept) - set(settings.formats)):
        asked = min(unknown) if kept else "no format"
        raise CheckpointError(f"{folder} does not write {asked}: it writes {', '.join(settings.formats)}")
    settings = replace(settings, name=name or settings.name, formats=kept)
    config[CONFIG_KEY] |= {"name": settings.name, "formats": list(kept)}
    card = update_card(folder, settings, {} if figures is None else {"figures": dict(figures)})
    config["auto_map"] = {auto: f"{_MODEL_CODE}.{LookTwiceVla.__name__}" for auto in _AUTO_MODELS}
    _write(path, json.dumps(config, indent=2, sort_keys=True))
    _write(folder / "processor_config.json", json.dumps(processor_config(settings), indent=2, sort_keys=True))
    _write(folder / "chat_template.jinja", chat_template(settings))
    for code, what, made in (
        (_MODEL_CODE, "The network", LookTwiceVla),
        (_PROCESSOR_CODE, "The processor", LookTwiceProcessor),
    ):
        text = _CODE.format(what=what, module=made.__module__, name=made.__name__)
        _write(folder / f"{code}.py", text.rstrip())
    _write(folder / CARD, model_card(card, settings))


def _write(path: Path, text: str) -> None:
    path.write_text(text + "\n", encoding="utf-8")


def model_card(card: Mapping[str, Any], settings: VlaSettings) -> str:
    """``README.md`` of a checkpoint, from its ``looktwice.json`` and its settings."""
    details, families = card["details"], [family_named(name) for name in settings.formats]
    inputs = ", ".join(("pictures", "ego history", *settings.inputs))
    lines = [
        "---",
        "license: apache-2.0",
        "library_name: transformers",
        "pipeline_tag: robotics",
        "tags: [autonomous-driving, vision-language-action, simulation]",
        "---",
        "",
        f"# {card['name']}",
        "",
        f"A model that {families[0].about}. "
        f"It has {card['parameters'] / 1e6:.1f} million parameters; revision `{card['revision']}`.",
        "",
        "**Not for road use.** It must not drive a vehicle, nor advise whoever drives one.",
        "",
        "## Use",
        "",
        "For research on driving models that say what they do, and to try out planners and their interfaces.",
        "",
        "```python",
        "from transformers import AutoModel, AutoProcessor",
        "",
        "from looktwice.model.bundled import SCENES",
        "from looktwice.model.driving.scene_store import read_scenes",
        "",
        "model = AutoModel.from_pretrained(FOLDER, trust_remote_code=True)",
        "processor = AutoProcessor.from_pretrained(FOLDER, trust_remote_code=True)",
        "scene = next(read_scenes(SCENES)).scene",
        "print(model(**processor(scene)).logits.shape)",
        "```",
        "",
        "Both need the package `looktwice`. Whole responses, decoded under their grammar, come from "
        "`looktwice plan --checkpoint FOLDER` and `looktwice serve --checkpoint FOLDER`.",
        "",
        "| | |",
        "|---|---|",
        f"| inputs | {inputs} |",
        f"| cameras | {', '.join(settings.cameras)}; {settings.image_width} x {settings.image_height} px, "
        "four pictures each, half a second apart |",
        f"| response formats | {', '.join(settings.formats)} |",
        f"| trajectory | {_trajectories(families, settings)} |",
        "",
        "## Limits",
        "",
        "- It has seen a simulator only, from two cameras; on real pictures its plans mean nothing.",
        "- It misses vehicles, pedestrians and barriers, and plans into them. A likely draw is no safe draw.",
        "- Its reasons are text that goes with a plan. They need not be why it plans so.",
        "",
        "## Data",
        "",
        *_trained(details),
        "",
        "## Figures",
        "",
        *_measured(details.get("figures") or {}),
    ]
    return "\n".join(lines)


def _trajectories(families: Sequence[Family], settings: VlaSettings) -> str:
    """Poses and times of what families give, and the codes that some write it in."""
    told = dict.fromkeys(f"{len(each.times_s)} poses up to {each.times_s[-1]:g} s" for each in families)
    pieces = [piece for each in families for piece in walk(each.format.body)]
    if any(isinstance(piece, Codes) and piece.alphabet == TRAJECTORY for piece in pieces):
        told[f"{CODES} codes of {settings.codec_size}"] = None
    return ", ".join(told)


def _trained(details: Mapping[str, Any]) -> Iterable[str]:
    stages = details.get("stages")
    if not stages:
        return ["No training is recorded in this folder."]
    return [
        "Scenes rendered in MetaDrive, driven by a scripted expert; no real drive. "
        "Stages of training, in order:",
        "",
        "| stage | steps | batch | scenes | episodes |",
        "|---|---|---|---|---|",
        *(f"| {' | '.join(str(stage.get(key, '')) for key in _STAGE_COLUMNS)} |" for stage in stages),
    ]


_STAGE_COLUMNS: Final = ("name", "steps", "batch_size", "examples", "episodes")


def _measured(figures: Mapping[str, str]) -> Iterable[str]:
    if not figures:
        return ["None are recorded; `looktwice evaluate --checkpoint FOLDER` measures them."]
    return [
        "| measured | value |",
        "|---|---|",
        *(f"| {what} | {value} |" for what, value in figures.items()),
    ]
