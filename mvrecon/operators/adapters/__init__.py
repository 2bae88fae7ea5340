"""mvrecon's operators and volumes as other libraries take them."""
