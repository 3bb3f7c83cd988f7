"""Many recordings with one command: found, shared among workers, taken up again; knows nothing of what is done."""
