"""Craftax-classic and Craftax (full): the tasks, their renderers, and what a frame shows as symbols."""
