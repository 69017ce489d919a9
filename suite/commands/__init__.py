"""The words of the command line, one module each; `suite.cli` lists them in `COMMANDS`.

A command's module has SUMMARY, its one line of help; `add_arguments(parser)`; and `execute(args)`, which does the work,
prints, and returns the exit code. Only these modules print. What imports JAX they import inside `execute`, after the
words are known to be right.
"""
