variable "bucket" {
  description = "Name of the bucket of the clusters' photos, results and state."
  type        = string
}

variable "prefix" {
  description = "Prefix of one cluster's objects in the bucket: its store is s3://bucket/prefix."
  type        = string
  default     = "cluster"
}

variable "oidc_provider_arn" {
  description = "IAM's name of the Kubernetes cluster's OpenID Connect provider, by which service accounts assume roles."
  type        = string
}

variable "namespace" {
  description = "Kubernetes namespace of the cluster's service accounts, which have the roles' names."
  type        = string
  default     = "plat"
}

variable "tags" {
  description = "Tags of all resources."
  type        = map(string)
  default     = {}
}
