// What a reader sees first: a particle in a potential with two wells, seen through noise.

export const EXAMPLE = {
  text: `# A particle in a potential with two wells, V(x) = a (x**4/4 - x**2/2),
# pushed by noise of size s and seen through noise of size r.
name = "particle in two wells"
state = ["x"]
drift = ["a*(x - x**3)"]
diffusion = [["s"]]
observation = ["x"]
observation_noise = [["r**2"]]
observation_kind = "samples"

[parameters]
a = 1.0
s = 0.6
r = 1.2

[prior]
kind = "gaussian"
mean = [0.0]
cov = [[1.0]]
`,
  data: { kind: "simulate", until: 60, step: 0.1, seed: 5 },
};
