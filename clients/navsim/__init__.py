"""An agent for NAVSIM (docs/drivers.md). Nothing here needs NAVSIM but `clients.navsim.agent.make_agent`."""
