"""What every room uses: errors, files, work on all cores, and how a command speaks."""
