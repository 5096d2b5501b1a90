"""Feed every reader of files with damaged and hostile ones."""
