# docker build -t rack . && docker run --rm --shm-size 1g rack
FROM python:3.12-slim
RUN apt-get update && apt-get install --yes --no-install-recommends make
WORKDIR /rack
COPY . .
RUN make quick
CMD ["make", "run"]
