"""Executors compute the groups of a plan.

In: group calls, plain data that any computer can take. Out: which nodes finished, which failed.
`executor` is the interface, `serial` works in this process, `ray` in processes of Ray.
"""
