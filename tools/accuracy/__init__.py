"""`softfinger accuracy`: what each rolling method costs and how far it strays."""
