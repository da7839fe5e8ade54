"""``make compat``: what other libraries make of the environments as they are, as a table.

Each library runs in a process of its own. A cell is ``yes`` where all that stands in its function has run, ``-`` where
a library has no such thing, and the first line of the error elsewhere.

- single: an environment by its id, checked by the library's own checker where it has one, and an episode.
- vector: many environments at once: ours where the library takes a vector environment, its own over single ones else.
- train: three iterations of the library's own PPO, or of what its loop is made of.
- infos: what the environment tells of a step arrives in what the library collects.
"""
