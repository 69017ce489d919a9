"""What each preset changes for each task. `paper` changes nothing for Craftax-classic: the defaults are the paper's.

Presets scale sizes and counts; what defines an agent is applied after them (`suite.registry`).
"""
