"""The long version of ``tests/faults``: commands are killed, stopped, starved and fed with damaged files at random."""
