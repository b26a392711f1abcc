"""The networks that the paper compares with: FIGNet, FIGNet*, MeshGraphNets, DPI."""
