variable "bucket" {
  description = "Name of the bucket that clusters keep photos, results and their state in."
  type        = string
}

variable "prefix" {
  description = "Where one cluster keeps its objects in the bucket: its store is s3://bucket/prefix."
  type        = string
  default     = "cluster"
}

variable "oidc_provider_arn" {
  description = "IAM's name of the Kubernetes cluster's OpenID Connect provider, by which service accounts become roles."
  type        = string
}

variable "namespace" {
  description = "Kubernetes namespace of the cluster's service accounts, which are called as the roles."
  type        = string
  default     = "plat"
}

variable "tags" {
  description = "Put on everything."
  type        = map(string)
  default     = {}
}
