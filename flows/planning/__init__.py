"""What has to be computed.

Here settings become plans: graphs of nodes, each with all that decides its result, and a rough
cost. In come `Settings`; out go plans, which :mod:`flows.pipeline` carries out.
"""
