"""The work of the commands on scenes and runs: simulate, plan, fit, identify, record, show, export."""
