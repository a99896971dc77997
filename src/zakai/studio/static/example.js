// What a reader sees first: a particle in a potential with two wells, of which mostly the distance from the middle is seen.

export const EXAMPLE = {
  text: `# A particle in two wells, pushed by noise.
# What is seen says how far from the middle it is,
# and hardly on which side: there are two peaks.
name = "particle in two wells"
state = ["x"]
drift = ["a*(x - x**3)"]
diffusion = [["s"]]
observation = ["x**2 + c*x"]
observation_noise = [["r**2"]]
observation_kind = "samples"

[parameters]
a = 1.0
s = 0.6
c = 0.2
r = 0.6

[prior]
kind = "gaussian"
mean = [0.0]
cov = [[1.0]]
`,
  data: { kind: "simulate", until: 60, step: 0.1, seed: 5 },
};
