"""Games as environments of the suite, one folder or file for each family.

Two of the folders also go the other way: the suite's tasks as Gymnasium's and PettingZoo's environments.

They import the interface and the registry's entries, and know no agent.
"""
