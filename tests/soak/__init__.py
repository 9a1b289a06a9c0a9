"""`make soak`: a small benchmark killed at random many times, and what must be left of it then.

`python -m tests.soak --kills 50 --seed 1`. `driver` is what is killed, the door of the whole
benchmark with checkpoints every fifth of a second; `processes` finds victims, among the soak's own
descendants alone; `server` is a real MLflow server, killed as well; `checks` compares a finished
store with that of an undisturbed run.
"""
