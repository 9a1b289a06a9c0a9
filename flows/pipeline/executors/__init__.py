"""Where the groups of a plan are computed.

In: group calls, plain data that any machine can take. Out: which nodes finished, which failed.
`executor` is the interface, `serial` works in this process, `ray` in processes of Ray.
"""
