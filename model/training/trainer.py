"""The trainer: `transformers.Trainer` with our batches, logs as JSON lines, and validation in metres."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset, Subset, get_worker_info
from transformers import Trainer, TrainerCallback, TrainingArguments

from looktwice.model.network.allocator import FreedMemory
from looktwice.model.network.card import LOG_FILE
from looktwice.model.network.vla import is_vision
from looktwice.model.training.recipes import Recipe
from looktwice.model.training.sampler import TaskSampler

_STATE_FILE: Final = "learner.pt"

Validate = Callable[[], Mapping[str, float]]


class LearnerTrainer(Trainer):
    """Trains a learner (a module whose forward gives the loss) on batches of its own sampler."""

    def __init__(
        self,
        learner: nn.Module,
        recipe: Recipe,
        stage: str,
        dataset: Dataset[Any],
        collate: Callable[[list[Any]], dict[str, torch.Tensor]],
        folder: Path,
        *,
        sampler: TaskSampler | None,
        validate: Validate | None,
        validate_every: int,
        save_every: int,
        bf16: bool,
        use_cpu: bool,
        workers: int,
    ) -> None:
        arguments = TrainingArguments(
            output_dir=str(folder / "state"),
            max_steps=recipe.steps,
            per_device_train_batch_size=recipe.batch_size,
            learning_rate=recipe.learning_rate,
            warmup_steps=recipe.warmup_steps,
            lr_scheduler_type="cosine",
            adam_beta1=0.9,
            adam_beta2=0.95,
            adam_epsilon=1e-8,
            weight_decay=recipe.weight_decay,
            max_grad_norm=1.0,
            logging_steps=50,
            save_steps=save_every,
            save_total_limit=1,
            seed=recipe.seed,
            bf16=bf16,
            use_cpu=use_cpu,
            report_to=[],
            remove_unused_columns=False,
            dataloader_num_workers=workers,
            disable_tqdm=True,
        )
        folder.mkdir(parents=True, exist_ok=True)
        super().__init__(
            model=learner,
            args=arguments,
            train_dataset=dataset,
            data_collator=collate,
            callbacks=[
                _Log(folder / LOG_FILE, stage, validate, validate_every),
                _Frugal(),
                *([] if sampler is None else [_Epochs(sampler)]),
            ],
        )
        self._recipe, self._sampler, self._dataset, self._learner = recipe, sampler, dataset, learner
        self._parts: dict[str, list[torch.Tensor]] = {}

    def get_train_dataloader(self) -> Any:
        """Batches of equal tasks where there is a sampler for them, of any examples elsewhere."""
        arguments = self.args
        chosen: dict[str, Any] = {"batch_sampler": self._sampler}
        if self._sampler is None:
            chosen = {"batch_size": arguments.train_batch_size, "sampler": self._get_train_sampler()}
        loader = DataLoader(
            self._dataset,
            collate_fn=self.data_collator,
            num_workers=arguments.dataloader_num_workers,
            persistent_workers=arguments.dataloader_num_workers > 0,
            pin_memory=not arguments.use_cpu,
            worker_init_fn=draw_apart,
            **chosen,
        )
        return self.accelerator.prepare(loader)

    def compute_loss(self, model: nn.Module, inputs: Any, *args: Any, **kwargs: Any) -> Any:
        """The learner's loss; the parts that it gives beside it are kept for the log."""
        outputs = model(**inputs)
        for name, value in outputs.items():
            if name != "loss":
                self._parts.setdefault(name, []).append(value.detach())
        return outputs["loss"]

    def log(self, logs: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        """Logs the parts' means since the last time along with the loss."""
        if "loss" in logs:
            logs |= {name: float(torch.stack(values).mean()) for name, values in self._parts.items()}
            self._parts.clear()
        super().log(logs, *args, **kwargs)

    def create_optimizer(self, *args: Any, **kwargs: Any) -> Any:
        """AdamW with the vision tower's own learning rate."""
        if self.optimizer is None:
            groups: dict[tuple[bool, bool], list[nn.Parameter]] = {}
            for name, parameter in self._learner.named_parameters():
                if parameter.requires_grad:
                    groups.setdefault((is_vision(name), parameter.ndim > 1), []).append(parameter)
            arguments = self.args
            self.optimizer = torch.optim.AdamW(
                [
                    {
                        "params": parameters,
                        "lr": arguments.learning_rate * (self._recipe.vision_rate if vision else 1.0),
                        "weight_decay": arguments.weight_decay if decayed else 0.0,
                    }
                    for (vision, decayed), parameters in groups.items()
                ],
                betas=(arguments.adam_beta1, arguments.adam_beta2),
                eps=arguments.adam_epsilon,
            )
        return self.optimizer

    # Tied weights make safetensors refuse a plain module; torch's own file keeps them tied.
    def _save(self, output_dir: str | None = None, state_dict: dict[str, Any] | None = None) -> None:
        folder = Path(str(output_dir or self.args.output_dir))
        folder.mkdir(parents=True, exist_ok=True)
        torch.save(state_dict or self._learner.state_dict(), folder / _STATE_FILE)

    def _load_from_checkpoint(self, resume_from_checkpoint: str, model: nn.Module | None = None) -> None:
        state = torch.load(Path(resume_from_checkpoint) / _STATE_FILE, map_location="cpu", weights_only=True)
        (model or self._learner).load_state_dict(state)


def draw_apart(worker: int) -> None:
    """Give a worker's dataset random numbers of its own: all workers begin as copies of one."""
    info: Any = get_worker_info()
    dataset = info.dataset
    while isinstance(dataset, Subset):
        dataset = dataset.dataset
    dataset.random = np.random.default_rng(info.seed)


class _Epochs(TrainerCallback):
    """Tells the sampler which epoch begins; where a run on several processes goes on, nobody else does."""

    def __init__(self, sampler: TaskSampler) -> None:
        self._sampler = sampler

    def on_epoch_begin(self, args: Any, state: Any, control: Any, **_: Any) -> None:
        self._sampler.set_epoch(int((state.epoch or 0) + 1e-6))


class _Frugal(TrainerCallback):
    """Gives back, now and then, what steps have freed.

    Batches of many sizes leave holes in the memory that `keep_freed_memory` keeps: 12 GB after 600 steps.
    """

    def __init__(self) -> None:
        self._freed = FreedMemory()

    def on_step_end(self, args: Any, state: Any, control: Any, **_: Any) -> None:
        self._freed.give_back()


class _Log(TrainerCallback):
    """Appends what the trainer logs, and validation figures, to a file of JSON lines."""

    def __init__(self, path: Path, stage: str, validate: Validate | None, every: int) -> None:
        self._path, self._stage, self._validate, self._every = path, stage, validate, every

    def on_log(
        self, args: Any, state: Any, control: Any, logs: dict[str, Any] | None = None, **_: Any
    ) -> None:
        if state.is_world_process_zero:
            self._write({"step": state.global_step, **(logs or {})})

    def on_step_end(self, args: Any, state: Any, control: Any, **_: Any) -> None:
        due = state.global_step % self._every == 0 or state.global_step == state.max_steps
        if due and self._validate and state.is_world_process_zero:
            self._write({"step": state.global_step, **self._validate()})

    def _write(self, row: Mapping[str, Any]) -> None:
        with self._path.open("a") as file:
            file.write(json.dumps({"stage": self._stage, **row}) + "\n")


def inherit_log(log: Path, sources: Sequence[Path]) -> None:
    """Begin a log that is not there yet with the rows of its sources, each row once."""
    if log.exists():
        return
    rows: dict[str, None] = {}
    for source in sources:
        if (source / LOG_FILE).exists():
            rows |= dict.fromkeys((source / LOG_FILE).read_text().splitlines(keepends=True))
    log.write_text("".join(rows))
