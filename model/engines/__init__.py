"""Engines that decode responses: the interface, our torch engine, vLLM."""
