"""Experiments of many runs: plans, executors, results tables and summaries."""
