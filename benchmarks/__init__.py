"""The measurements behind the performance table: ``python -m benchmarks``."""
