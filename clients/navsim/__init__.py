"""An agent for NAVSIM (docs/drivers.md). Nothing here needs NAVSIM but
`looktwice.clients.navsim.agent.make_agent`."""
