"""Motion: free flight, contacts, the two networks, the step."""
