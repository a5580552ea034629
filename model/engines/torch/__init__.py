"""The torch engine: a KV-cached, batched, format-constrained decoder, embedded in the process."""
