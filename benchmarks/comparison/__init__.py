"""What `compare.py`, `tune.py` and `plot.py` are made of.

`methods` says what is compared, `experiments` which of them on what; a `run` trains and evaluates one of
them; the `pool` executes many; `writing` puts their results on disk, a `study` reads them back;
`intervals`, `tables` and `claims` say what they mean.
"""
