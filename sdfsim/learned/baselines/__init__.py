"""The networks that SDF-Sim is compared with: FIGNet, FIGNet*, MeshGraphNets, DPI."""
