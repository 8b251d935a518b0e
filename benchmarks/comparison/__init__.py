"""What `compare.py`, `tune.py` and `plot.py` are made of.

`methods` says what is compared; a `run` trains and evaluates one of them; the `pool` executes many; a
`study` is their results on disk; `intervals`, `tables` and `claims` say what they mean.
"""
