"""Driving in alpasim and whatever else speaks its egodriver contract over gRPC (docs/drivers.md)."""
