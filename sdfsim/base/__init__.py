"""What every room uses: errors, files, work on all cores, options and output of commands."""
