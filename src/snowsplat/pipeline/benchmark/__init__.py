"""`benchmark`: trains and evaluates all scenes of a folder by the protocol of a benchmark suite.

`suites` has the protocols and the published figures, `job` trains one scene in its own process, and
`benchmark_page` writes the tables.
"""
