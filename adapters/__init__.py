"""Games as environments of the suite, and the suite's tasks in other libraries' interfaces.

Importing this package tells Gymnasium of every single-agent task; it builds no game and imports no JAX.
"""

from adapters.gymnasium_export import register_all

register_all()
