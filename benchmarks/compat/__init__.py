"""``make compat``: a table of which reinforcement learning libraries run the environments unchanged.

Each library runs in a process of its own. A cell is ``yes`` where its function ran to the end, ``-`` where the library
has no such feature, and the first line of the error elsewhere.

- single: an environment by its id, checked by the library's checker where there is one, and an episode.
- vector: many environments at once: our vector environment where the library takes one, else the library's.
- train: three iterations of the library's PPO, or of the parts of its loop.
- infos: the infos of a step arrive in the data that the library collects.
"""
