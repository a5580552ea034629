"""The vLLM engine: for checkpoints and clusters that outgrow the torch engine."""
