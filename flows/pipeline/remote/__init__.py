"""Stores that machines without a common disk share: a place that an fsspec URL names.

`places` says where this machine keeps its copy, `objects` reads and writes the common one,
`folders` carries artifacts and checkpoints between the two, `courier` reports and requests,
`claims` keeps drivers apart. `shared_artifacts` says when something is finished, `shared_store`
puts all behind the interface of the local store, and `bringing` serves those who only read.
"""
