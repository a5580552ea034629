"""Scenes at scale. A door: others import from here."""

from looktwice.clients.metadrive.generation.blocks import GenerateConfig, generate

__all__ = [
    "GenerateConfig",
    "generate",
]
