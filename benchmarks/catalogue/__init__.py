"""The parts of benchmarks/models.py: which models there are, what they ought to be, the page about them."""
