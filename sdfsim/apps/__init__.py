"""What the commands do with scenes and runs: simulate, plan, fit, identify, record, show, export."""
