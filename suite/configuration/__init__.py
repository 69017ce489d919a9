"""Every setting with its type, default and limits, and how a command line's words change them."""
